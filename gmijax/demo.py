"""`gmijax demo`: plays a policy that comes with gmijax, films it, and trains one if asked to.

Until the film is there no more is imported than it needs; nothing is downloaded or compiled.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from typing import Any, Final

from rich.console import Console

from gmijax.config import PlayConfig
from gmijax.config.env import PhysicsConfig
from gmijax.config.play import PlayRunConfig
from gmijax.control.console import SMALL_TASK, nearby, open_console, print_next, training_of
from gmijax.control.exit_codes import exit_code_of
from gmijax.control.output import write_output
from gmijax.deploy import shipped
from gmijax.deploy.pictures import film
from gmijax.deploy.shipped import SHIPPED
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import detect_machine
from gmijax.player.shipped import shipped_tasks
from gmijax.runs.folder import RunPaths, read_json
from gmijax.viewer.installed import missing

USAGE: Final = """usage: gmijax demo [env=TASK] [key=value ...]

Plays the policy that comes with gmijax for a task, ball_balance if none is named, and films it in
runs/shipped/TASK. Then it asks whether to train ball_balance here: about a minute on a GPU, a few
on two CPU cores. If you add keys of `gmijax train`, it trains that task with them without asking.
"""

TASK: Final = SMALL_TASK
CPU_STEPS: Final = 300_000
GPU_STEPS: Final = 3_000_000
PLAY_S, FILM_S = 2.0, 7.0
"""About so long it plays and draws."""

_EPISODES: Final = 16


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    if "--help" in argv or "-h" in argv:
        return exit_code_of("demo", lambda: write_output(USAGE))
    return exit_code_of("demo", lambda: _demo(argv))


def _demo(argv: Sequence[str]) -> None:
    if options := [text for text in argv if text.startswith("-")]:
        raise ConfigError(f"unknown option {options[0]}; allowed: --help, key=value")
    demo(argv)


def demo(overrides: Sequence[str]) -> None:
    """Plays and films; then trains with `overrides`, or if the user agrees.

    Raises:
      ConfigError: bad input, before anything was started.
      GmiFailed: a process failed.
    """
    names = [match[1] for text in overrides if (match := re.fullmatch(r"env=(\w+)", text))]
    task, has_keys = names[-1] if names else TASK, len(names) < len(overrides)
    config = _training(overrides, task) if has_keys else None
    console = open_console(show=True)
    if config is None or task in shipped_tasks():
        show_shipped(task, console)
    if config is None and _is_wanted():
        config = _training((), TASK)
    if config is None:
        print_next(console, *_next_steps(task))
    else:
        _train(config, console)


def show_shipped(task: str, console: Console) -> None:
    """Plays the policy that is shipped for a task, and films it.

    Raises:
      ConfigError: there is none.
      GmijaxError: playing failed.
    """
    config = shipped.checked(play_config(task))
    paths = shipped.folder_of(config)
    shipped.play(paths, PLAY_S)
    returns = read_json(paths.returns)
    for line in _told(task, returns):
        console.print(line)
    try:
        film(config, paths, returns["camera"], console, FILM_S)
    finally:
        paths.model.unlink(missing_ok=True)


def _next_steps(task: str) -> tuple[tuple[str, str], ...]:
    """What to type after the film of a policy."""
    watch = "watch whole episodes", f"gmijax view env={task} checkpoint={SHIPPED}"
    if missing():
        watch = "film whole episodes", f"gmijax play env={task} checkpoint={SHIPPED}"
    train = training_of(task, has_gpu=bool(detect_machine().gpus))
    others = [name for name in shipped_tasks() if name != task]
    if not others:
        return watch, train
    other = f"see another task: {', '.join(others)}", f"gmijax demo env={others[0]}"
    return watch, other, train


def play_config(task: str) -> PlayConfig:
    """As the demo plays the policy that is shipped for a task."""
    # Not by Hydra, which takes half a second.
    return PlayConfig(
        run=PlayRunConfig(dir=None, env=task),
        physics=PhysicsConfig(impl="auto"),
        checkpoint=SHIPPED,
        num_envs=_EPISODES,
        seed=0,
        deterministic=True,
        max_steps=None,
        video="auto",
        video_envs=None,
        html="off",
        width=640,
        height=480,
        camera=None,
    )


def _told(task: str, returns: dict[str, Any]) -> list[str]:
    """What it is and what it returns."""
    about, mean = returns["policy"], returns["return"]
    where = ""
    if about.get("train_wall_s") and about.get("device"):
        device = "a CPU" if about["device"] == "cpu" else f"one {about['device']}, beside others"
        where = f" in {about['train_wall_s']:.0f} s on {device}"
    metrics = [f"{name} {values['mean']:.2f}" for name, values in returns["metrics"].items()]
    return [
        f"{task}: a policy that gmijax trained for {returns['env_steps']:,} env steps{where}",
        f"{returns['num_envs']} episodes in MuJoCo: return {mean['mean']:.1f} "
        f"({mean['min']:.1f} to {mean['max']:.1f}), length {returns['length']['mean']:.0f} steps"
        + "".join(f", {text}" for text in metrics),
    ]


def _is_wanted() -> bool:
    """Whether the user at the terminal wants a training; no question without a terminal."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return False
    how_long = (
        "about a minute on this GPU" if detect_machine().gpus else "a few minutes on this CPU"
    )
    try:
        answer = input(f"Train {TASK} here now? It takes {how_long}. [y/N] ")
    except EOFError:
        return False
    return answer.strip().lower() in ("y", "yes")


def _training(overrides: Sequence[str], task: str) -> Any:
    """The configuration of a short training; raises ConfigError."""
    from gmijax.cli.compose import compose

    steps = GPU_STEPS if detect_machine().gpus else CPU_STEPS
    own = {"env": task, "num_timesteps": steps}
    given = {text.partition("=")[0] for text in overrides}
    short = [f"{key}={value}" for key, value in own.items() if key not in given]
    return compose(*short, *overrides)


def _train(config: Any, console: Console) -> None:
    """Trains, plays the last checkpoint and films it."""
    from gmijax.cli.compose import build
    from gmijax.control import job
    from gmijax.deploy import playing

    result = job.train(config, show=True)
    playing.play(build("play", PlayConfig, [f"run.dir={result.run_dir}"]), show=True)
    curve = RunPaths(result.run_dir).returns_png
    films = sorted(result.run_dir.glob("play/*/*.mp4"))
    has_curve = "none, no episode has ended"
    console.print(f"\ncurve of the returns: {nearby(curve) if curve.exists() else has_curve}")
    console.print(f"film: {nearby(films[-1]) if films else 'none, see above'}")
    print_next(
        console, ("train it anew with its full budget", f"gmijax train env={config.env.label}")
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
