"""`sweep.jobs_per_gpu=auto`: how many jobs at a time make the most steps, by profiling.

One job, two, four and so on train at the same time on one GPU, until more of them gain nothing or
cannot run. What was measured is kept in the profile store of `gmijax.search`. If the jobs are too
short for that to pay, as many run at the same time as fit in memory, up to eight.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from gmijax.autotune.grid import Measured, NotRunnable, Point
from gmijax.autotune.store import ProfileStore
from gmijax.autotune.tuner import workload_of
from gmijax.config.sweep import SweepConfig
from gmijax.control.console import doing, is_verbose
from gmijax.errors import ConfigError
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps.density import GAIN
from gmijax.sweeps.jobs import Job
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.packs import most_together
from gmijax.sweeps.profile_jobs import UNKNOWN_MIB, Bench, profile_jobs
from gmijax.sweeps.slots import gmis_per_slot, plan_slots

COUNTS = (1, 2, 4, 8, 16, 32)
CORES_OF_A_JOB = 2
"""On a machine without GPUs."""

_SHORT_S = 120.0
"""If all jobs of a GPU train for less than this one after another, more profiles cost more than
they save: each takes about half a minute."""

_MOST_UNMEASURED = 8


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
      console: for what was found.
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
    kinds: dict[object, list[Job]] = {}
    for job in jobs:
        config = job.config
        kind = config.env.label, config.num_envs, config.algo.name, _size(job)
        kinds.setdefault(kind, []).append(job)
    bench = Bench(hosts[0], scratch, signals)
    most = _most(settings, jobs, hosts)
    counts = [_best(settings, alike, most, jobs, bench, console) for alike in kinds.values()]
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


def _best(
    settings: SweepConfig,
    alike: Sequence[Job],
    most: int,
    jobs: Sequence[Job],
    bench: Bench,
    console: Console,
) -> int:
    """The number of such jobs at a time on the GPUs of one that makes the most steps.

    More than `most` are not profiled, but for the number that is next to it.
    """
    job, task = alike[0], alike[0].config.env.label
    together = most_together(settings, job, jobs)
    store = _store_of(job, bench, console)
    steps = most * max(one.config.num_timesteps for one in alike)
    best, best_rate, unmeasured = 1, 0.0, None
    for count in COUNTS:
        if best >= most:
            break
        if unmeasured and store.get(*_of_store(job, count, together)) is None:
            best = max(best, unmeasured)
            console.print(f"  {task}: too short to measure more; {best} at a time fit in memory")
            break
        found = _profiled(settings, job, count, together, bench, store, console)
        if isinstance(found, NotRunnable):
            console.print(f"  {task}: {count} jobs at a time cannot run: {found.reason}")
            break
        rate = count * found.env_steps_per_s
        console.print(
            f"  {task}: {count} jobs at a time make {rate:,.0f} steps/s, "
            f"{found.memory_mib:,.0f} MiB in each process"
        )
        if rate < best_rate * (1 + GAIN):
            break
        best, best_rate = count, rate
        if count == 1 and together == 1 and steps < _SHORT_S * rate:
            unmeasured = _that_fit(settings, job, most, found.memory_mib, bench)
    console.print(f"sweep.jobs_per_gpu={best} for {task}")
    return best


def _profiled(
    settings: SweepConfig,
    job: Job,
    count: int,
    together: int,
    bench: Bench,
    store: ProfileStore,
    console: Console,
) -> Measured | NotRunnable:
    """What so many jobs at a time do, kept or measured now; up to `together` are one program."""

    def measure() -> Measured | NotRunnable:
        label = job.config.env.label
        with doing(console, f"{label}: measuring {count} jobs at a time; they compile first"):
            return profile_jobs(settings, job, count, bench, together)

    kind, point = _of_store(job, count, together)
    return store.kept_or(kind, point, measure, job.config.search.profile_limit_s)


def _store_of(job: Job, bench: Bench, console: Console) -> ProfileStore:
    own = {"job": "sweep", "size": _size(job)}
    key = workload_of(job.config).store_key(bench.host.machine) | own
    return ProfileStore(job.config.search.store, key, console.print)


def _of_store(job: Job, count: int, together: int) -> tuple[str, Point]:
    """Under which the store keeps it."""
    packed = min(count, together)
    kind = "sweep" if packed == 1 else f"sweep {packed} together"
    return kind, Point(count, job.config.envs_per_gmi, str(job.config.physics.impl))


def _that_fit(
    settings: SweepConfig, job: Job, most: int, memory_mib: float, bench: Bench
) -> int | None:
    """As many of these jobs at a time as have `memory_mib` for each process, under MPS.

    None without MPS, where more jobs can be slower than one, and where memory is not known.
    """
    if memory_mib <= UNKNOWN_MIB:
        return None
    machine, size = bench.host.machine, gmis_per_slot(job.config)
    total_mib = {gpu.uuid: gpu.memory_mib for gpu in machine.gpus}
    for count in range(min(most, _MOST_UNMEASURED), 1, -1):
        asked = dataclasses.replace(settings, jobs_per_gpu=count)
        try:
            plan = plan_slots(asked, machine, {job.config.plan.backend})
        except ConfigError:
            continue
        if plan.backend != "mps":
            return None
        parts = [(one.memory_fraction or 0.0, total_mib[one.device]) for one in plan.allocations]
        if all(fraction * total / size >= memory_mib for fraction, total in parts):
            return count
    return 1
