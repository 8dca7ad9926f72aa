"""`sweep.jobs_per_gpu=auto`: how many jobs at a time make the most steps, by profiling.

One job, two, four and so on train at the same time on one GPU, until more of them gain nothing or
cannot run. What was measured is kept in the profile store of `gmijax.search`. Jobs that are over
before that pays run at the same time, as far as memory allows.
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
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps.density import GAIN
from gmijax.sweeps.jobs import Job
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.packs import most_together
from gmijax.sweeps.profile_jobs import Bench, profile_jobs
from gmijax.sweeps.slots import gmis_per_slot

COUNTS = (1, 2, 4, 8, 16, 32)
CORES_OF_A_JOB = 2
"""On a machine without GPUs."""

_SHORT_S = 120.0
"""Training that takes less, one job after another, gains nothing by more profiles: each number of
jobs takes about half a minute."""

_MOST_UNMEASURED = 8
_CONTEXT_MIB = 1024
"""Of GPU memory for a process, beside its arrays."""


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
    bench = Bench(hosts[0], scratch, signals)
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


def _best(
    settings: SweepConfig, job: Job, most: int, together: int, bench: Bench, console: Console
) -> int:
    """The number of such jobs at a time on the GPUs of one that makes the most steps.

    More than `most` are not profiled, but for the number that is next to it. Up to `together` of
    them are one program.
    """
    config, task = job.config, job.config.env.label
    own = {"job": "sweep", "size": _size(job)}
    key = workload_of(config).store_key(bench.host.machine) | own
    store = ProfileStore(config.search.store, key, console.print)
    best, best_rate = 1, 0.0
    for count in COUNTS:
        if best >= most:
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
        # What is known already costs nothing.
        is_new = store.get(*_of_store(job, COUNTS[1], together)) is None
        if count == 1 and together == 1 and is_new and _are_short(job, most, rate):
            best = _that_fit(most, found, bench)
            console.print(f"  {task}: all jobs are over before more is measured")
            break
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
    """What so many jobs at a time do, kept or measured now."""

    def measure() -> Measured | NotRunnable:
        label = job.config.env.label
        with doing(console, f"{label}: measuring {count} jobs at a time; they compile first"):
            return profile_jobs(settings, job, count, bench, together)

    kind, point = _of_store(job, count, together)
    return store.kept_or(kind, point, measure, job.config.search.profile_limit_s)


def _of_store(job: Job, count: int, together: int) -> tuple[str, Point]:
    """Under which the store keeps it."""
    packed = min(count, together)
    kind = "sweep" if packed == 1 else f"sweep {packed} together"
    return kind, Point(count, job.config.envs_per_gmi, str(job.config.physics.impl))


def _are_short(job: Job, most: int, steps_per_s: float) -> bool:
    """Whether as many jobs as each GPU has to run are soon over, one after another."""
    return most * job.config.num_timesteps < _SHORT_S * steps_per_s


def _that_fit(most: int, one: Measured, bench: Bench) -> int:
    """As many of these jobs at a time as memory allows, at least one."""
    memory_mib = min(gpu.memory_mib for gpu in bench.host.machine.gpus)
    return max(1, min(most, _MOST_UNMEASURED, int(memory_mib / (one.memory_mib + _CONTEXT_MIB))))
