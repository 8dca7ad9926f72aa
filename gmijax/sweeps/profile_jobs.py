"""Trains copies of a job at the same time for a few seconds, and measures how fast each was."""

from __future__ import annotations

import dataclasses
import signal
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from gmijax.autotune.grid import Measured, NotRunnable
from gmijax.config.sweep import SweepConfig
from gmijax.errors import GmijaxError, JobInterrupted, NodeLost
from gmijax.runs.result import TrainResult
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps.curve_window import CurveWindow
from gmijax.sweeps.jobs import Job
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.scheduler import Scheduler
from gmijax.sweeps.slots import Site, SlotPool, plan_slots
from gmijax.sweeps.study import Study
from gmijax.sweeps.training import TrainingKind

UNKNOWN_MIB = 1.0
"""Memory of jobs that did not report how much they took."""

_FOREVER = 10**12


class Bench(NamedTuple):
    """Where it is measured."""

    host: Host
    scratch: Path | None
    signals: StopSignals


def profile_jobs(
    settings: SweepConfig, job: Job, count: int, bench: Bench, together: int = 1
) -> Measured | NotRunnable:
    """Trains with `count` copies for a few seconds; what each of them did."""
    host, signals = bench.host, bench.signals
    gpus = settings.gpus if isinstance(settings.gpus, tuple) else None
    needed = job.num_gpus
    settings = dataclasses.replace(
        settings,
        jobs_per_gpu=count,
        gpus=gpus[:needed] if gpus else needed,
        objective="return",  # Only their speed is compared.
    )
    limit_s = job.config.search.profile_limit_s
    with tempfile.TemporaryDirectory(prefix="gmijax-", dir=bench.scratch) as folder:
        paths = SweepPaths(Path(folder))
        # Only those that have the same number of steps may be one program.
        jobs = [profiled_job(job, seed, _FOREVER + seed // together) for seed in range(count)]
        inner = StopSignals()
        window = CurveWindow(jobs, limit_s)

        def tick() -> None:
            # Once: a second signal would end the jobs before they report their memory.
            if not inner.have_come and (window.is_over() or signals.have_come):
                inner.handle(signal.SIGTERM)

        try:
            _train(jobs, settings, paths, host, tick, inner)
        except NodeLost:
            raise
        except JobInterrupted:
            if signals.have_come:
                raise
        except GmijaxError as error:
            return NotRunnable(" ".join(str(error).split()))
        if (rate := window.steps_per_s) is None:
            failed = next((j.progress.error for j in jobs if j.progress.error), None)
            return NotRunnable(failed or f"did not end within {limit_s:.0f} s", limit_s)
        return Measured(rate / count, _memory_mib(paths, jobs), window.iteration_s)


def _train(
    jobs: list[Job],
    settings: SweepConfig,
    paths: SweepPaths,
    host: Host,
    tick: Callable[[], None],
    signals: StopSignals,
) -> None:
    """Runs the jobs at the same time; `tick` is called meanwhile."""
    plan = plan_slots(settings, host.machine, {job.config.plan.backend for job in jobs})
    slots, kind = SlotPool([Site(plan, host.machine)]), TrainingKind(settings, paths)
    try:
        host.open(plan, paths)
        Scheduler(jobs, Study[Job](), kind, settings, paths, slots, [host], tick).run(signals)
    finally:
        host.shut()


def profiled_job(job: Job, seed: int, num_timesteps: int) -> Job:
    """The job with another seed and length, without what costs time or reports to anybody."""
    run = dataclasses.replace(
        job.config.run, checkpoint_every=0, measure_throughput=False, max_restarts=0, profile=None
    )
    config = dataclasses.replace(
        job.config,
        seed=seed,
        num_timesteps=num_timesteps,
        run=run,
        eval=dataclasses.replace(job.config.eval, every=None, video=False),
        wandb=dataclasses.replace(job.config.wandb, mode="off"),
    )
    return Job(seed, {}, config)


def _memory_mib(paths: SweepPaths, jobs: Sequence[Job]) -> float:
    """Peak memory of the largest job, MiB; `UNKNOWN_MIB` where none reports it."""
    results = [TrainResult.read(paths.job(job.number).gmi(0).result) for job in jobs]
    peaks = [one.peak_memory_mib or UNKNOWN_MIB for one in results if one is not None]
    return max(peaks, default=UNKNOWN_MIB)
