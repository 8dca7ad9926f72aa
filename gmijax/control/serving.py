"""The controller of `gmijax.serve`: from a policy to throughput, latency and experience.

Like `gmijax.control.job`, it checks everything that can be checked before anything is
started, runs the GMIs of a plan, and writes the summary however the job ends.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shlex
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from rich.console import Console

from gmijax.config import ServeConfig
from gmijax.config.schema import require_config, to_dict
from gmijax.control.console import Show, announce, nearby, open_console, print_next
from gmijax.control.decide import decide, with_task
from gmijax.control.progress import ConsoleProgress
from gmijax.control.serve_summary import serve_outcome, serve_summary
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.templates import SIMULATOR, group_of
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.compile_times import CompileTime
from gmijax.runs.dataset import DataPaths, open_dataset, remove_begun
from gmijax.runs.folder import (
    RunPaths,
    create_run,
    read_json,
    require_new_run,
    write_json,
)
from gmijax.runs.held import OpenFolder, gone_if_unused, locked
from gmijax.runs.history import MetricsReader, read_metrics
from gmijax.runs.resume import choose_checkpoint, is_training
from gmijax.runs.saved_config import left_out, trained_config
from gmijax.sim import source
from gmijax.supervise.job_kinds import serving_kind
from gmijax.supervise.run_gmis import Launch, recorded, run_gmis
from gmijax.supervise.watched_gmi import GmiStatus

_NOTHING_WRITTEN: Final = "nothing was written; to keep the experience, set output.dir=DIR"


class Served(NamedTuple):
    """Result of a serving job.

    Attributes:
      run_dir: the folder of the job.
      summary: the content of its `summary.json`.
      data_dir: the folder of the experience, None where nothing was written.
    """

    run_dir: Path
    summary: dict[str, Any]
    data_dir: Path | None


class _ServingJob(NamedTuple):
    """A serving job that is ready to start."""

    config: ServeConfig
    plan: Plan
    machine: Machine
    simulators: tuple[int, ...]
    data: DataPaths | None
    reasons: tuple[str, ...]

    @property
    def steps_per_unroll(self) -> int:
        return self.config.envs_per_gmi * self.config.unroll_length

    @property
    def wanted_unrolls(self) -> int:
        return len(self.simulators) * self.config.unrolls_per_gmi(len(self.simulators))

    def finished_unrolls(self) -> int:
        """Of the wanted ones, how many are in the output folder."""
        each = self.config.unrolls_per_gmi(len(self.simulators))
        if self.data is None:
            return 0
        return sum(min(self.data.num_finished(r), each) for r in range(len(self.simulators)))


def serve(config: ServeConfig, *, show: Show = False) -> Served:
    """Collects experience in the GMIs of a plan, and returns when all have ended.

    Args:
      config: see `gmijax.compose(..., command="serve")`.
      show: print the plan, live progress and the outcome; `verbose`: also why the plan is so.

    Raises:
      ConfigError: bad input, before anything was started.
      GmiFailed: a GMI failed; finished shards of experience stay.
      JobInterrupted: SIGINT, SIGTERM, SIGHUP or SIGUSR1 came; the same command continues with what
        is there.
    """
    require_config(config, ServeConfig)
    console = open_console(show=show)
    job = _prepared(config, console)
    folders: list[OpenFolder] = []
    with ExitStack() as held:
        if (data := job.data) is not None:
            is_new, is_begun = not data.root.exists(), data.dataset.exists()
            open_dataset(data, _about(job))
            shown = f"output.dir={nearby(data.root)}"
            folders.append(held.enter_context(locked(data.lock, shown)))
            if not is_begun:
                held.enter_context(_gone_without_shard(job, data, is_new=is_new))
        kept = job.finished_unrolls()
        if data is not None and kept and kept == job.wanted_unrolls:
            raise ConfigError(
                f"num_timesteps={job.config.num_timesteps}: output.dir={nearby(data.root)} "
                f"has {kept * job.steps_per_unroll} steps already; set num_timesteps above that"
            )
        env = job.config.env
        run = create_run(None, job.config.run.name, f"{env.slug}-serve")
        held.enter_context(gone_if_unused(run.root, partial(_has_collected_nothing, job, run)))
        folders.append(held.enter_context(OpenFolder(run.root, f"run.dir={nearby(run.root)}")))
        write_json(run.config, to_dict(job.config))
        write_json(run.plan, job.plan.to_dict())
        _announce(console, job, kept, run)
        try:
            summary = _run(job, kept, run, folders, console)
        finally:
            for folder in folders:
                folder.require()  # Whatever else went wrong without it comes from that.
    console.print(serve_outcome(summary, run))
    if shards := [] if job.data is None else list(job.data.finished()):
        path = json.dumps(nearby(shards[0].arrays))
        look = f"import numpy; print({{k: v.shape for k, v in numpy.load({path}).items()}})"
        print_next(console, ("look into the first shard", f"python -c {shlex.quote(look)}"))
    elif job.data is None:
        policy = "policy=random" if config.run.dir is None else f"run.dir={config.run.dir}"
        command = f"gmijax serve {policy} output.dir=data"
        print_next(console, ("write such experience to files", command))
    return Served(run.root, summary, None if job.data is None else job.data.root)


def _has_collected_nothing(job: _ServingJob, run: RunPaths) -> bool:
    return not any(read_metrics(run.gmi(gmi).metrics) for gmi in job.simulators)


def _gone_without_shard(
    job: _ServingJob, data: DataPaths, *, is_new: bool
) -> AbstractContextManager[None]:
    """Takes the job's files from its output folder again, unless a shard was finished."""
    return gone_if_unused(
        data.root,
        lambda: next(data.finished(), None) is None,
        lambda _: remove_begun(data, len(job.simulators), is_new=is_new),
    )


def _prepared(config: ServeConfig, console: Console) -> _ServingJob:
    """Everything that can be checked and decided without starting anything."""
    config = with_task(config)
    require_new_run(None, config.run.name)  # Before a search, which takes minutes.
    if config.run.dir is not None and (notice := source.executed(config.env)):
        console.print(notice)
    config, passed_over = _with_checkpoint(config)
    config, plan, machine, reasons = decide(config, console)
    data = None
    if config.output.dir is not None:
        data = DataPaths(Path(config.output.dir).resolve())
        output = dataclasses.replace(config.output, dir=str(data.root))
        config = dataclasses.replace(config, output=output)
    group = group_of(plan.layout, plan.roles, SIMULATOR)
    assert group is not None
    if config.run.dir is not None and (unknown := left_out(Path(config.run.dir))):
        reasons = (*reasons, unknown)
    return _ServingJob(config, plan, machine, group.gmis, data, (*reasons, *passed_over))


def _with_checkpoint(config: ServeConfig) -> tuple[ServeConfig, tuple[str, ...]]:
    """The configuration with `run.dir` as the path of a checkpoint, and the MJX that it wants.

    And what was passed over for that checkpoint.
    """
    if config.run.dir is None:
        return config, ()
    checkpoint, passed_over = choose_checkpoint(config.run.dir, "run.dir")
    meta = CheckpointMeta.read(checkpoint)
    trained, _ = trained_config(checkpoint)  # What is broken shows here, and not in every GMI.
    if meta.env != config.env.label:
        raise ConfigError(
            f"env={config.env.label}: run.dir={config.run.dir} was trained on {meta.env}"
        )
    if trained.history != config.env.history:
        raise ConfigError(
            f"env.history={config.env.history}: run.dir={config.run.dir} was trained with "
            f"{trained.history}"
        )
    physics = config.physics
    if physics.impl == "auto" and meta.impl == "jax":
        # A policy may depend on what it was trained with.
        physics = dataclasses.replace(physics, impl="jax")
    run = dataclasses.replace(config.run, dir=str(checkpoint))
    return dataclasses.replace(config, run=run, physics=physics), passed_over


def _about(job: _ServingJob) -> dict[str, Any]:
    """What all experience in one folder has in common, as it comes back from JSON."""
    config = job.config
    about = {
        "env": dataclasses.asdict(config.env),
        "impl": config.physics.impl,
        "policy": config.policy,
        "checkpoint_sha256": None if config.run.dir is None else _sha256(Path(config.run.dir)),
        "deterministic": config.deterministic,
        "seed": config.seed,
        "num_simulators": len(job.simulators),
        "num_envs": config.envs_per_gmi,
        "unroll_length": config.unroll_length,
        "next_obs": config.output.next_obs,
    }
    return json.loads(json.dumps(about))


def _sha256(checkpoint: Path) -> str:
    """Of the learner's files in a checkpoint, wherever it lies."""
    sha = hashlib.sha256()
    folder = checkpoint / "learner"
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            sha.update(path.relative_to(folder).as_posix().encode())
            sha.update(path.read_bytes())
    return sha.hexdigest()


class _CollectedLines:
    """The lines of all GMIs that simulate as one; for `ConsoleProgress`."""

    def __init__(self, run: RunPaths, simulators: Sequence[int], steps_before: int) -> None:
        self._readers = {gmi: MetricsReader(run.gmi(gmi).metrics) for gmi in simulators}
        self._lines: dict[int, dict[str, Any]] = {}
        self._steps_before = steps_before

    def new(self) -> list[dict[str, Any]]:
        """One line with sums of steps and rates and the mean return; none if nothing is new."""
        new = {gmi: line for gmi, reader in self._readers.items() if (line := reader.latest())}
        self._lines |= new
        if not new:
            return []
        lines = self._lines.values()
        returns = [line["return"] for line in lines if line["return"] is not None]
        line = {
            "env_steps": self._steps_before + sum(line["env_steps"] for line in lines),
            "env_steps_per_s": sum(line["env_steps_per_s"] for line in lines),
            "return": sum(returns) / len(returns) if returns else None,
        }
        return [line]


def _run(
    job: _ServingJob, kept: int, run: RunPaths, folders: Sequence[OpenFolder], console: Console
) -> dict[str, Any]:
    """Runs the GMIs; returns the summary, which is written however they end.

    Raises FolderLost if one of `folders`, which they write into, is no longer there.
    """
    started_s = time.monotonic()
    lines = _CollectedLines(run, job.simulators, kept * job.steps_per_unroll)
    total = job.wanted_unrolls * job.steps_per_unroll
    compile_time = CompileTime(_programs_of(job))
    progress = ConsoleProgress(console, lines.new, total, compile_time)

    def on_tick(gmis: tuple[GmiStatus, ...]) -> None:
        for folder in folders:
            folder.require()
        progress.update(gmis)

    def record(status: str, plan: Plan) -> None:
        wall_s = time.monotonic() - started_s
        summary = serve_summary(job.config, plan, run, status, wall_s)
        write_json(run.summary, summary | {"output": _output(job, kept)})

    launch = Launch(
        plan=job.plan,
        machine=job.machine,
        run=run,
        kind=serving_kind(job.config),
        timeouts=job.config.run,
        waits_after_ctrl_c=True,
        on_warning=console.print,
    )
    with recorded(run, partial(_what_is_left, job), record), progress:
        run_gmis(launch, on_tick)
    return read_json(run.summary)


def _programs_of(job: _ServingJob) -> dict[str, Any]:
    """What the time to compile a job's programs depends on."""
    plan, is_on_cpu = job.plan, job.plan.backend == "cpu"
    return {
        "command": "serve",
        **{name: to_dict(getattr(job.config, name)) for name in ("env", "physics")},
        "num_envs": plan.num_envs_per_gmi,
        "unroll_length": job.config.unroll_length,
        "layout": plan.layout.gmis_of_gpu,
        "template": plan.template,
        "device": "cpu" if is_on_cpu else job.machine.gpus[0].name,
    }


def _output(job: _ServingJob, kept: int) -> dict[str, Any] | None:
    """Content of the output folder, None without one."""
    if job.data is None:
        return None
    finished = list(job.data.finished())
    return {
        "dir": str(job.data.root),
        "shards": len(finished),
        "shards_kept": kept,
        "env_steps": len(finished) * job.steps_per_unroll,
        "bytes": sum(shard.arrays.stat().st_size for shard in finished),
    }


def _what_is_left(job: _ServingJob) -> str:
    if job.data is None:
        return _NOTHING_WRITTEN
    if not (done := job.finished_unrolls()):
        return "no shard was finished; the same command begins again"
    return (
        f"{done} of {job.wanted_unrolls} shards are in {nearby(job.data.root)}; "
        "the same command makes the rest"
    )


def _announce(console: Console, job: _ServingJob, kept: int, run: RunPaths) -> None:
    plan = job.plan
    what = (
        f"template {plan.template}, {plan.num_envs_per_gmi} environments in each of "
        f"{len(job.simulators)} GMIs"
    )
    announce(console, run, plan, what, job.reasons)
    if job.config.run.dir is not None:
        checkpoint = Path(job.config.run.dir)
        still = ", of a run that still trains" if is_training(checkpoint.parents[1]) else ""
        console.print(f"policy: {nearby(checkpoint)}{still}")
    if job.data is None:
        console.print("output.dir is not set: rates are measured, and no experience is written")
    if kept and job.data is not None:
        console.print(
            f"continuing {nearby(job.data.root)}: {kept} of {job.wanted_unrolls} shards are there",
        )
