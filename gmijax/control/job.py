"""The controller: from a configuration to a finished run. No jax here.

Checks everything that can be checked before anything is started, then makes the run folder,
enters the backend, runs the GMIs, and writes the summary however the job ends.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from gmijax.config import TrainConfig
from gmijax.control import dedicated, trained
from gmijax.control.auto import decided
from gmijax.control.decoupled import MODULE, is_decoupled, plan_decoupled, shared_blocks
from gmijax.control.launcher import Launch, patience_of, recorded, run_gmis
from gmijax.control.progress import ConsoleProgress, SilentProgress
from gmijax.control.selection import estimated_floats, with_measured
from gmijax.errors import ConfigError
from gmijax.partition.machine import Machine, detect_machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.results import MetricsReader, copy_history, draw_returns
from gmijax.resume import CheckpointMeta, check_fits, find_checkpoint, saved_config
from gmijax.rundir import RunPaths, create_run, read_json, write_json
from gmijax.schema import to_dict
from gmijax.sim import source
from gmijax.sim.impl import choose_impl
from gmijax.sim.registry import require_task


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

    def record(status: str, plan: Plan) -> None:
        summary = trained.summarise(config, plan, run, status, time.monotonic() - started)
        write_json(run.summary, summary)
        draw_returns(run.metrics, run.returns_png, f"{config.env.label}, {config.algo.name}")

    with recorded(run, partial(_what_is_left, run), record):
        _copy_history(config, run)
        with progress:
            run_gmis(_launch(config, plan, machine, run, console), progress.update)
    summary = read_json(run.summary)
    console.print(trained.outcome(summary, run))
    return Result(run.root, summary)


def _make_plan(config: TrainConfig, machine: Machine) -> Plan:
    if is_decoupled(config):
        return plan_decoupled(config, config.envs_per_gmi, machine)
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
    return Launch(
        plan=plan,
        machine=machine,
        run=run,
        module=_module(config, plan),
        # Agents and trainers compile different programs.
        compile_once=not is_decoupled(config) and not dedicated.is_dedicated(plan),
        shared=_shared(config, plan),
        patience=patience_of(config.run),
        on_warning=lambda text: console.print(text, markup=False),
    )


def _module(config: TrainConfig, plan: Plan) -> str:
    """Main of the GMIs."""
    if is_decoupled(config):
        return MODULE
    return dedicated.MODULE if dedicated.is_dedicated(plan) else "gmijax.workers.worker"


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
