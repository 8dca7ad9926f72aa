"""The controller: from a configuration to a finished run. No jax here.

Checks everything that can be checked before anything is started, then makes the run folder,
enters the backend, runs the GMIs, and writes the summary however the job ends.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from gmijax import dedicated
from gmijax.config import TrainConfig
from gmijax.decoupled import MODULE, is_decoupled, plan_decoupled, shared_blocks
from gmijax.errors import ConfigError, GmijaxError, JobInterrupted
from gmijax.launcher import Launch, run_gmis
from gmijax.partition.machine import Machine, detect_machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.partition.supervisor import Patience
from gmijax.progress import ConsoleProgress, SilentProgress
from gmijax.results import MetricsReader, copy_history, draw_returns, read_metrics
from gmijax.resume import CheckpointMeta, check_fits, find_checkpoint, saved_config
from gmijax.rundir import RunPaths, create_run, read_json, write_json
from gmijax.schema import to_dict
from gmijax.searching import decided
from gmijax.selection import estimated_floats, with_measured
from gmijax.sim import source
from gmijax.sim.impl import choose_impl
from gmijax.sim.registry import require_task
from gmijax.version import __version__

_ASYNCHRONOUS = ("pps", "ttop", "staleness", "bytes_per_s", "dropped")
"""Figures that only asynchronous training has."""

_VERSIONS = ("jax", "jaxlib", "mujoco-mjx", "flax", "optax", "orbax-checkpoint")


class Result(NamedTuple):
    """What a training job leaves.

    Attributes:
      run_dir: the run folder.
      summary: the content of its `summary.json`.
    """

    run_dir: Path
    summary: dict[str, Any]


def train(config: TrainConfig, *, show: bool = False) -> Result:
    """Trains a policy in the GMIs of a plan, and returns when all have ended.

    Args:
      config: see `gmijax.compose`.
      show: print the plan, live progress and the outcome.

    Raises:
      ConfigError: bad input, before anything was started.
      GmiFailed: a GMI failed; the run folder holds the logs and the last checkpoint.
      JobInterrupted: SIGINT, SIGTERM or SIGHUP came; its note says what is left to resume.
    """
    started = time.monotonic()
    require_task(str(config.env.name), config.env.suite)
    config = dataclasses.replace(config, env=source.pinned(config.env))
    config = _with_checkpoint(config)
    machine = detect_machine()
    console = Console(stderr=False, quiet=not show, soft_wrap=True, highlight=False)
    config, found = decided(config, machine, console)
    plan = _make_plan(config, machine)
    if config.reduce.selection == "measured":
        plan = _with_measured(config, plan, machine)
    config, reason = _with_impl(config, plan)
    run = create_run(config.run.dir, config.run.name, f"{config.env.slug}-{config.algo.name}")
    write_json(run.config, to_dict(config))
    write_json(run.plan, plan.to_dict())
    changed = _what_changed(config)
    _announce(console, plan, (*found, reason, *((changed,) if changed else ())), run)
    progress = (
        ConsoleProgress(console, MetricsReader(run.metrics), config.num_timesteps)
        if show
        else SilentProgress()
    )
    status = "failed"
    try:
        _copy_history(config, run)
        with progress:
            launch = _launch(config, plan, machine, run, console)
            run_gmis(launch, progress.update)
        status = "completed"
    except JobInterrupted as error:
        status = "interrupted"
        error.add_note(_what_is_left(run))
        raise
    except GmijaxError as error:
        error.add_note(f"run folder: {run.root}")
        raise
    finally:
        # A full disk must not hide why the job failed.
        with suppress(OSError):
            plan = Plan.from_dict(read_json(run.plan))  # Its backend may have been replaced.
            summary = _summarise(config, plan, run, status, time.monotonic() - started)
            write_json(run.summary, summary)
            draw_returns(run.metrics, run.returns_png, f"{config.env.label}, {config.algo.name}")
    summary = read_json(run.summary)
    console.print(_outcome(summary, run))
    return Result(run.root, summary)


def _make_plan(config: TrainConfig, machine: Machine) -> Plan:
    if is_decoupled(config):
        return plan_decoupled(config, machine)
    return make_plan(config.plan, config.reduce, config.envs_per_gmi, machine)


def _with_measured(config: TrainConfig, plan: Plan, machine: Machine) -> Plan:
    """The plan with the reduction that is fastest here, which may first have to be measured."""
    algo = config.algo
    hidden = (algo.policy_hidden_layer_sizes, algo.value_hidden_layer_sizes)
    return with_measured(plan, machine, estimated_floats(*hidden), config.reduce.intra)


def _with_impl(config: TrainConfig, plan: Plan) -> tuple[TrainConfig, str]:
    """The configuration with `physics.impl` decided, and the reason in words."""
    platform = "cpu" if plan.backend == "cpu" else "gpu"
    impl, why = choose_impl(config.physics.impl, platform, config.env.label)
    decided = dataclasses.replace(config, physics=dataclasses.replace(config.physics, impl=impl))
    return decided, f"physics.impl {impl}: {why}"


def _what_changed(config: TrainConfig) -> str | None:
    """Says that a resumed run's custom task is no longer the same, None where nothing changed."""
    if config.run.resume is None:
        return None
    return source.changes(config.env, saved_config(Path(config.run.resume))["env"])


def _what_is_left(run: RunPaths) -> str:
    """What an interrupted job leaves, in words."""
    if run.gmi(0).result.exists() and read_json(run.gmi(0).result)["status"] == "completed":
        return f"training was complete: {run.root}"
    if any(run.checkpoints.glob("[0-9]*")):
        return f"continue with run.resume={run.root}"
    return "there is no checkpoint yet"


def _copy_history(config: TrainConfig, run: RunPaths) -> None:
    if config.run.resume:
        checkpoint = Path(config.run.resume)
        steps = CheckpointMeta.read(checkpoint).env_steps
        copy_history(RunPaths(checkpoint.parent.parent).metrics, run.metrics, steps)


def _with_checkpoint(config: TrainConfig) -> TrainConfig:
    """The configuration with `run.resume` as the path of a checkpoint that fits."""
    wanted = config.run.resume
    if wanted is None:
        return config
    checkpoint = find_checkpoint(wanted, "run.resume")
    meta = CheckpointMeta.read(checkpoint)
    algo = config.algo
    expected = dataclasses.replace(
        meta,
        env=config.env.label,
        algo=algo.name,
        hidden=(algo.policy_hidden_layer_sizes, algo.value_hidden_layer_sizes),
    )
    check_fits(meta, expected, "run.resume", wanted)
    seed = read_json(RunPaths(checkpoint.parent.parent).config)["seed"]
    if config.seed != seed:
        raise ConfigError(f"seed={config.seed}: a resumed run keeps its seed {seed}")
    if meta.env_steps >= config.num_timesteps:
        raise ConfigError(
            f"num_timesteps={config.num_timesteps}: the checkpoint has {meta.env_steps} "
            "steps already; give more in all"
        )
    return dataclasses.replace(config, run=dataclasses.replace(config.run, resume=str(checkpoint)))


def _launch(
    config: TrainConfig, plan: Plan, machine: Machine, run: RunPaths, console: Console
) -> Launch:
    times = config.run
    return Launch(
        plan=plan,
        machine=machine,
        run=run,
        module=_module(config, plan),
        # Agents and trainers compile different programs.
        compile_once=not is_decoupled(config) and not dedicated.is_dedicated(plan),
        shared=_shared(config, plan),
        patience=Patience(
            start_timeout_s=times.start_timeout_s,
            stall_timeout_s=times.stall_timeout_s,
            stop_timeout_s=times.stall_timeout_s,
            grace_s=times.grace_s,
        ),
        on_warning=lambda text: console.print(text, markup=False),
    )


def _module(config: TrainConfig, plan: Plan) -> str:
    """Main of the GMIs."""
    if is_decoupled(config):
        return MODULE
    return dedicated.MODULE if dedicated.is_dedicated(plan) else "gmijax.worker"


def _shared(config: TrainConfig, plan: Plan) -> Mapping[str, Callable[[], int]]:
    """The memory that the GMIs share, beside that of the reducer."""
    if is_decoupled(config):
        return shared_blocks(config, plan)
    return dedicated.shared_blocks(plan) if dedicated.is_dedicated(plan) else {}


def _announce(console: Console, plan: Plan, more: Sequence[str], run: RunPaths) -> None:
    layout = [list(gmis) for gmis in plan.layout.gmis_of_gpu]
    console.print(f"run folder: {run.root}")
    console.print(
        f"plan: layout {layout}, backend {plan.backend}, {plan.num_envs_per_gmi} environments "
        f"per GMI, template {plan.template}, reduction {plan.strategy}",
        markup=False,
    )
    for text in (*plan.reasons, *more):
        console.print(f"  {text}", markup=False)


def _summarise(
    config: TrainConfig, plan: Plan, run: RunPaths, status: str, wall_s: float
) -> dict[str, Any]:
    result = read_json(run.gmi(0).result) if run.gmi(0).result.exists() else _last_known(run)
    checkpoints = sorted(run.checkpoints.glob("[0-9]*"))
    return {
        "status": status,
        "env": config.env.label,
        "algo": config.algo.name,
        "plan": {
            "backend": plan.backend,
            "layout": [list(gmis) for gmis in plan.layout.gmis_of_gpu],
            "num_envs_per_gmi": plan.num_envs_per_gmi,
            "strategy": plan.strategy,
            "intra": result.get("intra", plan.intra),
            "selection": dict(plan.selection),
            "template": plan.template,
            "roles": list(plan.roles),
        },
        "env_steps": result.get("env_steps"),
        "wall_s": wall_s,
        "train_wall_s": result.get("train_wall_s"),
        "compile_s": result.get("compile_s"),
        "env_steps_per_s": result.get("env_steps_per_s"),
        "step_per_s_sim": result.get("step_per_s_sim"),
        "step_per_s_inference": result.get("step_per_s_inference"),
        "step_per_s_train": result.get("step_per_s_train"),
        **{key: result[key] for key in _ASYNCHRONOUS if key in result},
        "final_return": result.get("final_return"),
        "overflow_steps": result.get("overflow_steps") or {},
        "checkpoint": str(checkpoints[-1]) if checkpoints else None,
        "versions": {"gmijax": __version__, "python": sys.version.split()[0]}
        | _installed_versions(),
        "device": result.get("device"),
        "impl": config.physics.impl,
    }


def _last_known(run: RunPaths) -> dict[str, Any]:
    """What the metrics say of a job that did not end by itself."""
    lines = read_metrics(run.metrics)
    if not lines:
        return {}
    return {"env_steps": lines[-1]["env_steps"], "final_return": lines[-1]["return"]}


def _installed_versions() -> dict[str, str | None]:
    found: dict[str, str | None] = {}
    for name in _VERSIONS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found


def _outcome(summary: dict[str, Any], run: RunPaths) -> str:
    def rate(key: str) -> str:
        value = summary[key]
        return "-" if value is None else f"{value:,.0f}"

    final = summary["final_return"]
    return (
        f"{summary['status']}: {summary['env_steps']:,} env steps in {summary['wall_s']:.0f} s, "
        f"final return {'-' if final is None else format(final, '.2f')}\n"
        f"env steps/s: {rate('step_per_s_sim')} simulation, "
        f"{rate('step_per_s_inference')} with inference, "
        f"{rate('step_per_s_train')} with training\n"
        f"checkpoint: {summary['checkpoint']}\nsummary: {run.summary}"
    ) + "".join(
        f"\nwarning: MJX-Warp's {name} buffer was too small in {count:,.0f} environment steps"
        for name, count in summary["overflow_steps"].items()
        if count
    )
