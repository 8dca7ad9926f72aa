"""`sweep.jobs_per_gpu=auto`: how many jobs at a time make the most steps, by profiling.

One job, two, four and so on train at the same time on one GPU, until more of them gain nothing or
cannot run. What was measured is kept in the profile store of `gmijax.search`.
"""

from __future__ import annotations

import dataclasses
import signal
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from gmijax.autotune.grid import Measured, NotRunnable, Point
from gmijax.autotune.store import ProfileStore
from gmijax.autotune.tuner import workload_of
from gmijax.clock import running_s
from gmijax.config.sweep import SweepConfig
from gmijax.control.console import doing, is_verbose
from gmijax.errors import GmijaxError, JobInterrupted, NodeLost
from gmijax.runs.result import TrainResult
from gmijax.supervise.run_gmis import StopSignals
from gmijax.sweeps.density import GAIN
from gmijax.sweeps.jobs import Job
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.packs import most_together
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.scheduler import Scheduler
from gmijax.sweeps.slots import Site, SlotPool, gmis_per_slot, plan_slots
from gmijax.sweeps.study import Study
from gmijax.sweeps.training import TrainingKind

COUNTS = (1, 2, 4, 8, 16, 32)
_WINDOW_S = 4.0
_LEAST_ITERATIONS = 6
CORES_OF_A_JOB = 2
"""On a machine without GPUs."""

_FOREVER = 10**12


def with_jobs_per_gpu(
    settings: SweepConfig,
    jobs: Sequence[Job],
    hosts: Sequence[Host],
    console: Console,
    signals: StopSignals,
    scratch: Path | None = None,
) -> SweepConfig:
    """The settings with a number of jobs per GPU.

    Of jobs of several kinds the one that allows the fewest decides. GPUs are measured on the first
    of several machines, of machines without any the smallest decides.

    Args:
      settings: of the sweep.
      jobs: of it, some of each kind.
      hosts: its machines; backends are not entered.
      console: told what was found.
      signals: end it.
      scratch: folder for what is measured, which the first machine sees; None: a temporary one.

    Raises:
      ConfigError: a job that cannot be profiled.
      JobInterrupted: a signal came.
    """
    if settings.jobs_per_gpu != "auto":
        return settings
    if not hosts[0].machine.gpus:
        fewest = min(len(host.machine.cpu_cores) for host in hosts)
        count = max(1, fewest // CORES_OF_A_JOB)
        if is_verbose(console):
            console.print(f"sweep.jobs_per_gpu={count}: {CORES_OF_A_JOB} cores for each job")
        return dataclasses.replace(settings, jobs_per_gpu=count)
    kinds: dict[object, Job] = {}
    for job in jobs:
        config = job.config
        kind = config.env.label, config.num_envs, config.algo.name, _size(job)
        kinds.setdefault(kind, job)
    bench = _Bench(hosts[0], scratch, signals)
    most = _most(settings, jobs, hosts)
    counts = [
        _best(settings, job, most, most_together(settings, job, jobs), bench, console)
        for job in kinds.values()
    ]
    return dataclasses.replace(settings, jobs_per_gpu=max(1, min(*counts, most)))


def _size(job: Job) -> tuple[int, int]:
    """GPUs of a job, and its GMIs on each."""
    return job.num_gpus, gmis_per_slot(job.config)


def _most(settings: SweepConfig, jobs: Sequence[Job], hosts: Sequence[Host]) -> int:
    """Jobs per GPU with which all run at the same time."""
    gpus = settings.gpus
    num_gpus = sum(
        len(gpus) if isinstance(gpus, tuple) else gpus or len(host.machine.gpus) for host in hosts
    )
    num_jobs = settings.trials or len(jobs)
    return -(-num_jobs * max(job.num_gpus for job in jobs) // num_gpus)


class _Bench(NamedTuple):
    """Where it is measured."""

    host: Host
    scratch: Path | None
    signals: StopSignals


def _best(
    settings: SweepConfig, job: Job, most: int, together: int, bench: _Bench, console: Console
) -> int:
    """The number of such jobs at a time on the GPUs of one that makes the most steps.

    More than `most` are not profiled, but for the number that is next to it. Up to `together` of
    them are one program.
    """
    config = job.config
    own = {"job": "sweep", "size": _size(job)}
    key = workload_of(config).store_key(bench.host.machine) | own
    store = ProfileStore(config.search.store, key, console.print)
    limit_s = config.search.profile_limit_s
    best, best_rate = 1, 0.0
    for count in COUNTS:
        if best >= most:
            break
        point = Point(count, config.envs_per_gmi, str(config.physics.impl))
        packed = min(count, together)
        kind = "sweep" if packed == 1 else f"sweep {packed} together"

        def measure(count: int = count) -> Measured | NotRunnable:
            what = f"{config.env.label}: measuring {count} jobs at a time; they compile first"
            with doing(console, what):
                return _profile(settings, job, count, bench, together)

        found = store.kept_or(kind, point, measure, limit_s)
        if isinstance(found, NotRunnable):
            console.print(
                f"  {config.env.label}: {count} jobs at a time cannot run: {found.reason}"
            )
            break
        rate = count * found.env_steps_per_s
        console.print(
            f"  {config.env.label}: {count} jobs at a time make {rate:,.0f} steps/s, "
            f"{found.memory_mib:,.0f} MiB in each process"
        )
        if rate < best_rate * (1 + GAIN):
            break
        best, best_rate = count, rate
    console.print(f"sweep.jobs_per_gpu={best} for {config.env.label}")
    return best


def _profile(
    settings: SweepConfig, job: Job, count: int, bench: _Bench, together: int = 1
) -> Measured | NotRunnable:
    """Trains with `count` copies for a few seconds; what each of them did."""
    host, signals = bench.host, bench.signals
    gpus = settings.gpus if isinstance(settings.gpus, tuple) else None
    needed = job.num_gpus
    settings = dataclasses.replace(
        settings, jobs_per_gpu=count, gpus=gpus[:needed] if gpus else needed
    )
    limit_s = job.config.search.profile_limit_s
    with tempfile.TemporaryDirectory(prefix="gmijax-", dir=bench.scratch) as folder:
        paths = SweepPaths(Path(folder))
        # Only those that have the same number of steps may be one program.
        jobs = [_copy(job, seed, _FOREVER + seed // together) for seed in range(count)]
        inner = StopSignals()
        window = _CurveWindow(jobs, limit_s)

        def tick() -> None:
            # Once: a second signal would end the jobs before they say how much memory they took.
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
            return NotRunnable(failed or f"no end within {limit_s:.0f} s", limit_s)
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


def _copy(job: Job, seed: int, num_timesteps: int) -> Job:
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


class _CurveWindow:
    """Steps of jobs while all of them train.

    Attributes:
      steps_per_s: of all together; None where they did not come so far.
      iteration_s: seconds of an iteration of the first job.
    """

    def __init__(self, jobs: Sequence[Job], limit_s: float) -> None:
        self._jobs = jobs
        self._deadline_s = running_s() + limit_s
        self._seen = [{0} for _ in jobs]
        self._start: tuple[float, list[int]] | None = None
        self.steps_per_s: float | None = None
        self.iteration_s = 0.0

    def is_over(self) -> bool:
        """Looks at the jobs; whether enough was seen, or one has failed, or it takes too long."""
        now_s = running_s()
        steps = [job.progress.env_steps for job in self._jobs]
        for seen, own in zip(self._seen, steps, strict=True):
            seen.add(own)
        # The first iterations of some fall into the compilation of others.
        if self._start is None and min(map(len, self._seen)) > 2:
            self._start = now_s, steps
            self._seen = [{own} for own in steps]
        if self._start is not None and min(map(len, self._seen)) > _LEAST_ITERATIONS:
            started_s, before = self._start
            if now_s - started_s >= _WINDOW_S:
                self.steps_per_s = (sum(steps) - sum(before)) / (now_s - started_s)
                self.iteration_s = (now_s - started_s) / (len(self._seen[0]) - 1)
                return True
        has_failed = any(job.progress.state == "failed" for job in self._jobs)
        return has_failed or now_s > self._deadline_s


def _memory_mib(paths: SweepPaths, jobs: Sequence[Job]) -> float:
    """Peak memory of the largest job, MiB."""
    results = [TrainResult.read(paths.job(job.number).gmi(0).result) for job in jobs]
    return max([one.peak_memory_mib or 1.0 for one in results if one is not None], default=1.0)
