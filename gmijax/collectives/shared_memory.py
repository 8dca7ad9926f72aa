"""Shared memory without a name: the controller makes it, its processes inherit and map it.

An anonymous file vanishes with the last process that has it open, so nothing is left behind
whichever process is killed, and it does not count against the size of /dev/shm. `Fence` keeps the
order of accesses to it.
"""

from __future__ import annotations

import mmap
import os
import threading

import numpy as np

from gmijax.errors import CollectiveError
from gmijax.machine.processes import ProcessId, own_process


class Fence:
    """Keeps the processor from moving memory accesses across a call of it.

    A release followed by an acquire of one lock does that on all processors of interest; the
    lock is private and never contended, so that this costs 0.1 us.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def __call__(self) -> None:
        """All accesses before this one are done before those after it."""
        self._lock.release()
        self._lock.acquire()


def fence() -> None:
    """The same in one call, for threads that may come at once, where 0.4 us do not count."""
    Fence()()


def create_file(name: str, num_bytes: int = 0) -> int:
    """Makes an anonymous file of zeros, which takes memory where it is written; its descriptor."""
    fd = os.memfd_create(f"gmijax-{name}", os.MFD_CLOEXEC)
    # Another user who may look into /proc/<pid>/fd must not read or change anything.
    os.fchmod(fd, 0o600)
    os.ftruncate(fd, num_bytes)
    return fd


def map_file(fd: int, num_bytes: int, user: str) -> mmap.mmap:
    """Maps a file whose size the first process to map it sets; all its memory is taken.

    Raises:
      CollectiveError: no memory, or no such descriptor; names `user`.
    """
    try:
        # Unlike ftruncate this never shrinks the file, which would crash (SIGBUS) processes that
        # have mapped more of it, and it fails here, not at first touch, if memory is short.
        os.posix_fallocate(fd, 0, num_bytes)
        return mmap.mmap(fd, num_bytes, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
    except OSError as error:
        raise CollectiveError(
            f"{user}: cannot map {num_bytes / 2**20:.1f} MiB of shared memory at descriptor {fd} "
            f"({error.strerror})"
        ) from None


def take_line(line: np.void, gmi: int) -> None:
    """Notes this process in the line that shows others GMI `gmi`.

    Raises:
      CollectiveError: it is taken.
    """
    if line["pid"]:
        raise CollectiveError(f"GMI {gmi} is taken already by process {line['pid']}")
    process = own_process()
    line["start_ticks"] = process.start_ticks
    fence()  # A pid with another start would seem to be a process that is gone.
    line["pid"] = process.pid


def process_of(line: np.void) -> ProcessId:
    """The process that has taken a line; that with pid 0, which never runs, if none has."""
    pid = int(line["pid"])
    fence()  # See `take_line`.
    return ProcessId(pid, int(line["start_ticks"]))


def round_up(value: int, multiple: int) -> int:
    """The next multiple of `multiple`."""
    return -(-value // multiple) * multiple


def whole_pages(num_bytes: int) -> int:
    """Bytes of the pages that hold so many."""
    return round_up(num_bytes, mmap.PAGESIZE)
