"""The controller of `gmijax.play`: from a checkpoint to returns and a film.

Two children do the work, each a fresh interpreter: `gmijax.workers.playback` runs the episodes
as the one GMI of a small plan, `gmijax.workers.play_film` films them.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.table import Table

from gmijax.config import (
    PlanConfig,
    PlayConfig,
    ReduceConfig,
    Timeouts,
)
from gmijax.config.schema import to_dict
from gmijax.control.console import (
    Show,
    doing,
    nearby,
    open_console,
    print_next,
    training_of,
)
from gmijax.control.progress import ConsoleProgress
from gmijax.control.summary import EXPLORING
from gmijax.deploy import shipped
from gmijax.deploy.pictures import film, write_page
from gmijax.deploy.shipped import SHIPPED
from gmijax.deploy.trained_run import open_run, output_folder
from gmijax.errors import ConfigError, GmijaxError
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.partition.planner import make_plan
from gmijax.player.joystick import robot_of
from gmijax.player.walking import ONE_ACTION, lines_of
from gmijax.runs.compile_times import CompileTime
from gmijax.runs.folder import (
    POLICY,
    PlayPaths,
    RunPaths,
    read_json,
)
from gmijax.runs.history import read_metrics
from gmijax.runs.saved_config import trained_config
from gmijax.sim.registry import TASKS, draws_models
from gmijax.supervise.job_kinds import JobKind
from gmijax.supervise.run_gmis import Launch, run_gmis
from gmijax.viewer.installed import INSTALL, missing

MEMORY_FRACTION: Final = 0.1
"""Most of a GPU's memory that playing takes: beside a training job that reserves 0.8."""

_TIMEOUTS: Final = Timeouts(
    start_timeout_s=1200.0, stall_timeout_s=600.0, stop_timeout_s=60.0, grace_s=10.0
)


def play(config: PlayConfig, *, show: Show = False) -> None:
    """Runs one episode per environment with the policy of a checkpoint, and films some of them.

    Args:
      config: what to play; see `python -m gmijax.play --help`.
      show: print a table of the returns, and the paths of the files.

    Raises:
      ConfigError: bad input, e.g. no such run or checkpoint.
      GmiFailed: the evaluation failed.
      GmijaxError: a film was asked for and could not be made; the returns are there.
    """
    _require_page(config)
    console = open_console(show=show)
    if config.checkpoint == SHIPPED:
        config = shipped.checked(config)
        paths = shipped.folder_of(config)
        with doing(console, f"playing {config.num_envs} episodes"):
            shipped.play(paths)
    else:
        config, changed = _opened(config)
        # A film of an earlier evaluation must not lie beside the returns of this one.
        paths = PlayPaths(output_folder(config, "play", lambda root: PlayPaths(root).results()))
        console.print(f"checkpoint: {nearby(Path(str(config.checkpoint)))}")
        if changed:
            console.print(changed)
        machine = detect_machine()
        compile_time = CompileTime(_programs_of(config, machine))
        work = f"playing {config.num_envs} episodes"
        with ConsoleProgress(console, list, 0, compile_time, work) as progress:
            run_gmis(launch_of(config, paths, machine), progress.update)
    _show(config, paths, console)


def _programs_of(config: PlayConfig, machine: Machine) -> dict[str, Any]:
    """What the time to compile them depends on."""
    env, algo = trained_config(Path(str(config.checkpoint)))
    return {
        "command": "play",
        **{name: to_dict(part) for name, part in (("env", env), ("algo", algo))},
        "physics": to_dict(config.physics),
        "num_envs": config.num_envs,
        "randomize": config.randomize,
        "device": machine.gpus[0].name if machine.gpus else "cpu",
    }


def _show(config: PlayConfig, paths: PlayPaths, console: Console) -> None:
    """Prints the returns, and makes the pictures."""
    returns = read_json(paths.returns)
    console.print(returns_table(returns))
    if config.checkpoint != SHIPPED and (note := _return_while_training(config, returns)):
        console.print(note)
    if "walking" in returns:
        console.print(walking_lines(config, returns["walking"]))
    console.print(f"returns: {nearby(paths.returns)}")
    if not paths.model.exists():
        without_film(config, returns["env"], console)
        print_next(console, *_next_steps(config, returns["env"]))
        return
    try:
        if config.html != "off":
            write_page(config, paths, console)
        if config.video != "none":
            film(config, paths, returns["camera"], console)
    finally:
        # With its textures a robot takes 100 MB, for every checkpoint that is played.
        paths.model.unlink(missing_ok=True)
    print_next(console, *_next_steps(config, returns["env"]))


def walking_lines(config: PlayConfig, walk: Mapping[str, Any] | None) -> str:
    """The lines of a walking test: its results, or why there was none."""
    if walk is not None:
        return "\n".join(lines_of(walk))
    if config.walking_envs == 0:
        return "no walking test: walking_envs=0"
    repeat = trained_config(Path(str(config.checkpoint)))[0].action_repeat
    if repeat != 1:
        return f"no walking test: env.action_repeat={repeat}; {ONE_ACTION}"
    return "no walking test without a GPU, unless it is asked for: walking_envs=8 takes minutes"


def _return_while_training(config: PlayConfig, returns: Mapping[str, Any]) -> str | None:
    """A line on why training printed another return; None where it did not."""
    lines = read_metrics(RunPaths(Path(str(config.run.dir))).metrics)
    at_it = [line.get("return") for line in lines if line["env_steps"] == returns["env_steps"]]
    if not at_it or at_it[-1] is None or not returns["deterministic"]:
        return None
    return f"return during training: {at_it[-1]:.2f} {EXPLORING}"


def _next_steps(config: PlayConfig, label: str) -> tuple[tuple[str, str], ...]:
    if config.checkpoint == SHIPPED:
        task = config.run.env
        view = ("watch it in the browser", f"gmijax view env={task} checkpoint={SHIPPED}")
        train = training_of(str(task), has_gpu=bool(detect_machine().gpus))
        return (train,) if missing() else (view, train)
    folder = shlex.quote(nearby(Path(str(config.run.dir))))
    view = ("watch it in the browser", f"gmijax view run.dir={folder}")
    export = ("write the policy as files for a robot", f"gmijax export run.dir={folder}")
    # The viewer has our tasks alone, and needs what checkpoints of older versions do not have.
    has_policy = (Path(str(config.checkpoint)) / POLICY).exists()
    can_view = label in TASKS and has_policy and not missing()
    return (view, export) if can_view else (export,)


def _require_page(config: PlayConfig) -> None:
    if config.html == "on" and (absent := missing()):
        raise ConfigError(
            f"html=on: needs {' and '.join(absent)} ({INSTALL}); without it: auto, off"
        )


def _opened(config: PlayConfig) -> tuple[PlayConfig, str | None]:
    """As `open_run`, with what only playing asks for checked too."""
    config, env, changed = open_run(config)
    if config.randomize == "on" and not draws_models(env):
        why = "env.randomization of the run names nothing to draw"
        if env.suite == "playground":
            why = f"Playground has no randomisation for {env.label}; allowed: off"
        raise ConfigError(f"randomize=on: {why}")
    if config.walking_envs:
        asked = f"walking_envs={config.walking_envs}"
        if robot_of(env) is None:
            raise ConfigError(f"{asked}: {env.label} has no walking test; allowed: 0, null")
        if env.action_repeat != 1:
            raise ConfigError(f"{asked}: env.action_repeat={env.action_repeat}; {ONE_ACTION}")
    return config, changed


def launch_of(config: PlayConfig, paths: PlayPaths, machine: Machine) -> Launch:
    """The process that plays, on a machine where another job may be training."""
    one_gmi = PlanConfig(memory_fraction=MEMORY_FRACTION if machine.gpus else None)
    return Launch(
        plan=make_plan(one_gmi, ReduceConfig(), config.num_envs, machine),
        machine=machine,
        run=RunPaths(paths.root),
        kind=JobKind("gmijax.workers.playback"),
        timeouts=_TIMEOUTS,
        stops_gracefully=False,
        # The GPU may be training: take what is needed when it is needed, up to the fraction.
        variables={"XLA_PYTHON_CLIENT_PREALLOCATE": "false"},
    )


def without_film(config: PlayConfig, env: str, console: Console) -> None:
    """Prints that an environment without a model has no film; an error if one was requested."""
    reason = f"{env} has no model that could be filmed; the returns were evaluated"
    if config.video not in ("auto", "none") or config.html == "on":
        raise GmijaxError(reason)
    if config.video == "auto":
        console.print(reason)


def returns_table(returns: Mapping[str, Any]) -> Table:
    """Means and spreads of the episodes in a `returns.json`, for people."""
    how = "without exploration noise" if returns["deterministic"] else "with exploration noise"
    diverged = returns["num_diverged"]
    table = Table(
        title=f"{returns['env']} after {returns['env_steps']:,} env steps, {how}",
        caption=(
            f"{returns['num_envs']} episodes: {returns['num_terminated']} terminated"
            f"{f' ({diverged} of them diverged)' if diverged else ''}, "
            f"{returns['num_truncated']} ran out of time, {returns['num_cut_off']} cut off; "
            f"{returns['compile_s']:.1f} s compiling, {returns['run_s']:.1f} s running"
        ),
    )
    table.add_column("per episode")
    for heading in ("mean", "std", "min", "max"):
        table.add_column(heading, justify="right")
    rows = {"return": returns["return"], "length": returns["length"]}
    rows |= {f"  {name}": term for name, term in returns["terms"].items()}
    rows |= returns["metrics"]
    for name, row in rows.items():
        table.add_row(name, *(f"{row[key]:.2f}" for key in ("mean", "std", "min", "max")))
    return table
