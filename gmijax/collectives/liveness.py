"""Whether another process of this machine is still there."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

STATE, START_TICKS = 0, 19  # positions behind the command name in /proc/<pid>/stat


class ProcessIdentity(NamedTuple):
    """One process for ever: numbers of processes are used again, pairs with a start time not.

    Attributes:
      pid: the process id.
      start_ticks: when it started, in clock ticks since boot.
    """

    pid: int
    start_ticks: int


def own_process() -> ProcessIdentity:
    """The calling process."""
    # Not os.getpid(): all ranks look at each other through /proc, which may number differently.
    pid = int(Path("/proc/self").readlink().name)
    return ProcessIdentity(pid, int(_stat_fields(pid)[START_TICKS]))


def is_alive(process: ProcessIdentity) -> bool:
    """Whether `process` exists and has not ended (a zombie has)."""
    try:
        fields = _stat_fields(process.pid)
    except OSError:
        return False
    ended = fields[STATE] in (b"Z", b"X")
    return not ended and int(fields[START_TICKS]) == process.start_ticks


def _stat_fields(pid: int) -> list[bytes]:
    # The command name may contain blanks and brackets; everything behind the last one is plain.
    return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
