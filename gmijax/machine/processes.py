"""Processes of this host, asked about in /proc, and pipes to our own; stdlib only."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from gmijax.clock import running_s, wait_for
from gmijax.errors import printable

_POLL_S = 0.02
_ENDED = (b"Z", b"X")


class GuardPipe:
    """The write end of a pipe whose end of file shows a child that this process is gone.

    A process that the caller forks while the pipe is open would hold it open for longer than this
    one lives, so it is closed in every fork.

    Attributes:
      read_end: for the child; the caller closes it once that is started.
    """

    # What `os.register_at_fork` calls cannot be taken back: one function, over those open now.
    _open: ClassVar[set[int]] = set()

    def __init__(self) -> None:
        self.read_end, self._write_end = os.pipe()
        self._open.add(self._write_end)

    def write(self, data: bytes) -> None:
        """Sends bytes; the child may have ended."""
        with suppress(OSError):
            os.write(self._write_end, data)

    def close(self) -> None:
        """Ends the pipe; idempotent."""
        if self._write_end in self._open:
            self._open.discard(self._write_end)
            os.close(self._write_end)
        self._write_end = -1

    @classmethod
    def _close_all(cls) -> None:
        for fd in cls._open:
            with suppress(OSError):
                os.close(fd)
        cls._open.clear()


os.register_at_fork(after_in_child=GuardPipe._close_all)


class ProcessId(NamedTuple):
    """One process, distinct from a later one that got the same number."""

    pid: int  # The process's number.
    start_ticks: int  # When it started, clock ticks since the machine booted.

    def is_running(self) -> bool:
        """Whether exactly this process runs; a zombie does not."""
        return identify(self.pid) == self


def identify(pid: int) -> ProcessId | None:
    """The running process with number `pid`, or None (also for a zombie)."""
    try:
        process, state, *_ = _parse(Path(f"/proc/{pid}/stat").read_bytes())
    except OSError:
        return None
    return None if state in _ENDED else process


def own_process() -> ProcessId:
    """The calling process."""
    # Not os.getpid(): processes look at each other through /proc, which may number differently.
    return _parse(Path("/proc/self/stat").read_bytes())[0]


def members_of(group: int) -> tuple[ProcessId, ...]:
    """The running processes of a process group; no zombies."""
    return tuple(process for process, its_group, _ in _running() if its_group == group)


def started_by(group: int) -> tuple[ProcessId, ...]:
    """The running processes of a process group and their descendants, also in other groups.

    Children of a process that has ended are left out, unless they are in the group themselves.
    """
    running = tuple(_running())
    found = {process.pid: process for process, its_group, _ in running if its_group == group}
    while more := [p for p, _, parent in running if parent in found and p.pid not in found]:
        found |= {process.pid: process for process in more}
    return tuple(found.values())


def _running() -> Iterator[tuple[ProcessId, int, int]]:
    """Every running process with its group and its parent."""
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError):  # It may end meanwhile.
            process, state, group, parent = _parse((entry / "stat").read_bytes())
            if state not in _ENDED:
                yield process, group, parent


def that_have_open(path: Path) -> dict[int, str]:
    """Numbers and names of the processes of this host that have a file open, as far as is known.

    Those of other users are not.
    """
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # It may end meanwhile.
            if any(_leads_to(fd, path) for fd in (entry / "fd").iterdir()):
                found |= names_of([int(entry.name)])
    return found


def names_of(pids: Iterable[int]) -> dict[int, str]:
    """Numbers and names of those of the processes that have not ended, of any user."""
    found = {}
    for pid in pids:
        with suppress(OSError):
            name = Path(f"/proc/{pid}/comm").read_text(errors="replace")
            found[pid] = printable(name.strip())
    return found


def _leads_to(fd: Path, path: Path) -> bool:
    try:
        # First by name: what lies on a network is not asked for nothing.
        return Path(os.readlink(fd)).name == path.name and os.path.samefile(fd, path)
    except OSError:
        return False


def wait_until_gone(processes: Iterable[ProcessId], timeout_s: float) -> tuple[ProcessId, ...]:
    """Waits until all have ended; returns those that still run after `timeout_s`."""
    deadline_s = running_s() + timeout_s
    left = tuple(process for process in processes if process.is_running())
    while left and running_s() < deadline_s:
        time.sleep(_POLL_S)
        left = tuple(process for process in left if process.is_running())
    return left


def has_ended(process: subprocess.Popen[Any], timeout_s: float) -> bool:
    """Waits until a child has ended; whether it has in time."""

    def wait(seconds: float) -> bool:
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        return True

    return wait_for(wait, timeout_s)


def _parse(stat: bytes) -> tuple[ProcessId, bytes, int, int]:
    """The process that a line of /proc/<pid>/stat is about, its state, its group, its parent."""
    # The second field is the program's name in brackets, which may itself hold blanks and
    # brackets: count from the last one.
    fields = stat.rpartition(b")")[2].split()
    process = ProcessId(int(stat.partition(b" ")[0]), int(fields[19]))
    return process, fields[0], int(fields[2]), int(fields[1])
