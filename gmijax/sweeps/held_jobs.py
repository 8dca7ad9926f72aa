"""Jobs that wait because a process still runs in their folder."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from gmijax.clock import running_s
from gmijax.machine.processes import ProcessId, names_of, that_have_open
from gmijax.runs.held import is_locked
from gmijax.sweeps.any_job import AnyJob
from gmijax.sweeps.paths import SweepPaths

_SAID_AFTER_S: Final = 5.0
"""What was killed is gone by then, as a rule."""

_ENDING_S: Final = 1.0
"""For the end of a process that was just killed."""

_POLL_S: Final = 0.05

_LIMIT_S: Final = 120.0
"""For the end of what a machine that is gone, or a killed command, has left."""


class HeldJobs:
    """Which jobs cannot start yet, since when, and what they wait for.

    A killed process of a job, or one of a machine that is gone, may still save; and one that has
    left the process group of its job is not ended with that. Two must not train in one folder.

    Args:
      paths: files of the jobs; each has a lock.
    """

    def __init__(self, paths: SweepPaths) -> None:
        self._paths = paths
        self._since_s: dict[int, float] = {}

    def has(self, job: AnyJob) -> bool:
        """Whether a process holds the folder of a waiting job; its note soon names the process."""
        lock, progress = self._paths.job(job.number).lock, job.progress
        if not is_locked(lock):
            if self._since_s.pop(job.number, None) is not None:
                progress.note = None
            return False
        waited_s = running_s() - self._since_s.setdefault(job.number, running_s())
        if progress.note is None and waited_s >= _SAID_AFTER_S:
            progress.note = (
                f"{_holds(lock)}; the job fails if that still runs after {_LIMIT_S:g} s, and no "
                "other job does"
            )
        return True

    def forget(self, job: AnyJob) -> None:
        """A job has started."""
        self._since_s.pop(job.number, None)

    def are_all(self, jobs: Iterable[AnyJob]) -> bool:
        """Whether all of these wait for such processes; so for none."""
        return all(job.number in self._since_s for job in jobs)

    def why_failed(self, job: AnyJob) -> str | None:
        """Why a job of the queue is not waited for any longer; None: it is."""
        since_s = self._since_s.get(job.number)
        if since_s is None or running_s() - since_s < _LIMIT_S:
            return None
        del self._since_s[job.number]
        job.progress.note = None
        was = f"; it was to run {job.progress.error}" if job.progress.error else ""
        return f"{_holds(self._paths.job(job.number).lock)}, then give the same command{was}"


def left_behind(
    jobs: Iterable[AnyJob], paths: SweepPaths, killed: Sequence[tuple[Path, ProcessId]]
) -> list[str]:
    """Which processes of jobs that were ended still run, in words: a text for each such job.

    Args:
      jobs: all.
      paths: their files.
      killed: processes that did not end at once when they were killed, each with the lock of its
        job; they may not hold it, `sudo` closes it.
    """
    locks = {job.number: paths.job(job.number).lock for job in jobs if job.progress.attempts}
    deadline_s = running_s() + _ENDING_S
    while True:
        left = [(lock, process.pid) for lock, process in killed if process.is_running()]
        of_job = {n: [pid for at, pid in left if at == lock] for n, lock in locks.items()}
        held = {n: lock for n, lock in locks.items() if of_job[n] or is_locked(lock)}
        if not held or running_s() >= deadline_s:
            break
        time.sleep(_POLL_S)
    return [f"job {number}: {_holds(lock, of_job[number])}" for number, lock in held.items()]


def _holds(lock: Path, known: Iterable[int] = ()) -> str:
    """Which processes hold a folder, beside those that are known, and what to do."""
    found = names_of(known) | that_have_open(lock)
    if not found:
        return f"a process that is not found here still holds {lock}: end it"
    names = ", ".join(f"{pid} ({name})" for pid, name in found.items())
    one = len(found) == 1
    return (
        f"process{'' if one else 'es'} {names}, started earlier, still run{'s' if one else ''} in "
        f"its folder: end {'it' if one else 'them'} (kill {' '.join(map(str, found))})"
    )
