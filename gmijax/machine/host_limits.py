"""How many GMIs a host takes: cores, memory, threads, open files. Starts nothing, needs no jax.

A GMI is a whole interpreter with jax in it. More of them than the host can run do not fail one by
one: they take the machine down. So `gmijax.partition.planner` checks these limits before it plans.
"""

from __future__ import annotations

import math
import os
import resource
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

from gmijax.errors import ConfigError

N = TypeVar("N", int, float)

# Measured on two cores, jax 0.10.2: `env=ball_balance num_envs=64 plan.gmis_per_gpu=2`, compiled
# and training. Each of the two GMIs had 750 and 787 MiB resident, of which 552 and 588 MiB were
# its own and the rest files that GMIs share; 16 and 19 threads; the controller had 9 open files.
# Tasks with more environments or larger models need more: these are what no GMI does without.
CPU_GMI_MIB = 600
GPU_GMI_MIB = 1000
"""Beside a GPU: about half of the least peak of resident memory in the 200 records of
`benchmarks/results/` (1,874 to 6,841 MiB); how much of it GMIs share was not measured."""

THREADS_OF_A_GMI = 24
FILES_OF_A_GMI = 4
"""Open in the controller: a lifeline, and for a moment what a start needs."""

FILES_OF_A_JOB = 64

GMIS_PER_CORE = 16
"""On the cpu backend, where GMIs do all their work on cores: with more each of them would wait
for its core longer than it computes, and twice as many would compile at a time."""


class HostLimits(NamedTuple):
    """Free resources for the GMIs of a job, None where unknown or unlimited.

    Attributes:
      memory_mib: of the machine, or of the control group that this process is in.
      threads: that may still be started.
      open_files: that this process may still open.
    """

    memory_mib: float | None = None
    threads: int | None = None
    open_files: int | None = None


UNKNOWN_HOST: Final = HostLimits()
"""Takes any number of GMIs."""


def detect_host() -> HostLimits:
    """Looks at this machine, and at the limits that this process is under."""
    groups = CgroupLimits()
    page_mib = os.sysconf("SC_PAGE_SIZE") / 2**20
    open_files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return HostLimits(
        memory_mib=_least(os.sysconf("SC_PHYS_PAGES") * page_mib, groups.memory_mib()),
        threads=_least(_threads_of_user(), _threads_of_machine(), groups.threads()),
        open_files=None
        if open_files == resource.RLIM_INFINITY
        else open_files - len(os.listdir("/proc/self/fd")),
    )


def require_host_capacity(
    num_gmis: int, what: str, host: HostLimits, num_cores: int, *, on_cpu: bool
) -> None:
    """Raises ConfigError if a job has more GMIs than the host takes; one is always allowed.

    Args:
      num_gmis: of the whole job.
      what: the settings that say so, for the message.
      host: see `detect_host`.
      num_cores: that the job may use.
      on_cpu: the GMIs compute on cores, and not on GPUs.
    """
    needs = list(_needs(num_gmis, host, num_cores, on_cpu=on_cpu))
    if lacking := [text for most, text in needs if most < num_gmis]:
        most = min(most for most, _ in needs)
        raise ConfigError(
            f"{what}: {num_gmis} GMIs on this machine need about {', '.join(lacking)}; "
            f"allowed: at most {most}"
        )


def usable_cores(cores: Sequence[int], quota: float | None, name: str) -> tuple[int, ...]:
    """As many of the cores as a control group's quota of CPU time is worth.

    Which ones depends on the host's name: containers of one machine, each with a quota and all
    its cores to choose from, must not all pin their GMIs to the first ones.
    """
    count = len(cores) if quota is None else min(len(cores), max(1, math.ceil(quota)))
    first = zlib.crc32(name.encode()) % (len(cores) - count + 1)
    return tuple(cores[first : first + count])


class CgroupLimits:
    """Limits of the control groups (version 1 or 2) that this process is in, and those above.

    Args:
      own: which groups those are.
      root: where groups are files.
    """

    def __init__(
        self, own: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")
    ) -> None:
        self._root = root
        try:
            self._lines = own.read_text().splitlines()
        except OSError:
            self._lines = []

    def memory_mib(self) -> float | None:
        """Memory of all processes of the group, MiB."""
        names = ("memory.max", "memory.limit_in_bytes")
        limits = (_number(folder, names) for folder in self._folders("memory"))
        return _least(*(limit / 2**20 for limit in limits if limit is not None))

    def available_memory_mib(self) -> float | None:
        """Memory that processes of the group can still have, MiB."""
        left: list[float] = []
        for folder in self._folders("memory"):
            limit = _number(folder, ("memory.max", "memory.limit_in_bytes"))
            used = _number(folder, ("memory.current", "memory.usage_in_bytes"))
            if limit is not None and used is not None:
                left.append(max(0, limit - used + _cached_bytes(folder)) / 2**20)
        return _least(*left)

    def threads(self) -> int | None:
        """Threads that may still be started."""
        left: list[int] = []
        for folder in self._folders("pids"):
            limit, now = _number(folder, ("pids.max",)), _number(folder, ("pids.current",))
            if limit is not None:
                left.append(limit - (now or 0))
        return _least(*left)

    def cpu_quota(self) -> float | None:
        """Cores' worth of time that the group gets."""
        quotas: list[float] = []
        for folder in self._folders("cpu"):
            with suppress(OSError, ValueError):
                quota, period = (folder / "cpu.max").read_text().split()
                if quota != "max":
                    quotas.append(int(quota) / int(period))
            quota = _number(folder, ("cpu.cfs_quota_us",))
            period = _number(folder, ("cpu.cfs_period_us",))
            if quota is not None and period and quota > 0:  # -1: no limit.
                quotas.append(quota / period)
        return _least(*quotas)

    def _folders(self, controller: str) -> Iterator[Path]:
        """The group's folder and those above; some of them may not be seen from in here."""
        for line in self._lines:
            number, names, path = line.split(":", 2)
            if number == "0" and not names:
                base = self._root
            elif controller in names.split(","):
                base = self._root / controller
            else:
                continue
            parts = Path(path.lstrip("/")).parts
            for length in range(len(parts), -1, -1):
                yield base.joinpath(*parts[:length])


def _needs(
    num_gmis: int, host: HostLimits, num_cores: int, *, on_cpu: bool
) -> Iterator[tuple[int, str]]:
    """For how many GMIs each resource is enough, and the text if these are too few."""

    def capacity(available: float, each: float) -> int:
        return max(1, int(available // each))

    if host.memory_mib is not None:
        each = CPU_GMI_MIB if on_cpu else GPU_GMI_MIB
        text = f"{_gib(num_gmis * each)} of memory (there are {_gib(host.memory_mib)})"
        yield capacity(host.memory_mib, each), text
    if on_cpu:
        needed = math.ceil(num_gmis / GMIS_PER_CORE)
        text = f"{needed} CPU cores, one for every {GMIS_PER_CORE} (there are {num_cores})"
        yield num_cores * GMIS_PER_CORE, text
    if host.threads is not None:
        text = f"{num_gmis * THREADS_OF_A_GMI} threads ({host.threads} may still be started)"
        yield capacity(host.threads, THREADS_OF_A_GMI), text
    if host.open_files is not None:
        needed = FILES_OF_A_JOB + num_gmis * FILES_OF_A_GMI
        text = f"{needed} open files ({host.open_files} may still be opened, see ulimit -n)"
        yield capacity(host.open_files - FILES_OF_A_JOB, FILES_OF_A_GMI), text


def _gib(mib: float) -> str:
    return f"{mib / 1024:.3g} GiB"


def _threads_of_user() -> int | None:
    """Threads that this user may still start (RLIMIT_NPROC), which root always may."""
    limit = resource.getrlimit(resource.RLIMIT_NPROC)[0]
    user = os.geteuid()
    if limit == resource.RLIM_INFINITY or user == 0:
        return None
    running = 0
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # It may end meanwhile.
            if process.stat().st_uid == user:
                running += (process / "task").stat().st_nlink - 2
    return limit - running


def _threads_of_machine() -> int | None:
    """Threads that the kernel can still start."""
    with suppress(OSError, ValueError, IndexError):
        kernel = Path("/proc/sys/kernel")
        limits = [int((kernel / name).read_text()) for name in ("pid_max", "threads-max")]
        running = int(Path("/proc/loadavg").read_text().split()[3].partition("/")[2])
        return min(limits) - running
    return None


def _number(folder: Path, names: Sequence[str]) -> int | None:
    """The number in the first of the files that has one; None for `max`."""
    for name in names:
        with suppress(OSError, ValueError):
            return int((folder / name).read_text())
    return None


def _cached_bytes(folder: Path) -> int:
    """Cached files of a group and those in it; version 1 counts these as `total_`."""
    with suppress(OSError, ValueError):
        counts = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        names = ("active_file", "inactive_file")
        return sum(int(counts.get(f"total_{name}", counts.get(name, 0))) for name in names)
    return 0


def _least(*values: N | None) -> N | None:
    return min((value for value in values if value is not None), default=None)
