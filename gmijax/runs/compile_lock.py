"""One process compiles a program, others with the same compilation cache wait and load it.

Every program has a file in the cache that its compiler holds by `flock`. The kernel releases it
when the process ends, however it ends. Once it is compiled the file names its entries in the
cache. While these are there no process takes the lock, so that all load at the same time. One that
has waited in vain compiles beside the others: the compiler was killed, or the disk is full.
"""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from typing import Final, TypeVar

from gmijax.clock import running_s

T = TypeVar("T")

ON_WAIT: Final[list[Callable[[], AbstractContextManager[None]]]] = []
"""Entered by this process while it waits for another one."""

LONGEST_WAIT_S: Final = 1200.0
"""As long as `run.start_timeout_s` is by default. On NFSv3 the lock of a machine that has lost its
power stays until that machine is up again."""

_POLL_S: Final = 0.05

_NO_ENTRY: Final = "."
"""Stands for the cache itself: the program is one of those that cannot be kept."""


def compile_alone(cache: Path, name: str, key: str, compile_program: Callable[[], T]) -> T:
    """What `compile_program` returns, called by one process at a time until it is in the cache.

    Where there can be no such file, or it cannot be locked, it is called at once.

    Args:
      cache: folder of the compilation cache.
      name: of the program, with which the names of its entries begin.
      key: the same in all processes in which one entry serves.
      compile_program: compiles it, or loads it from the cache.
    """
    file = cache / f"{name}-{key}-lock"
    with ExitStack() as held:
        if not _is_compiled(file):
            _hold_or_wait(file, held)
        if _is_compiled(file):
            held.close()
            return compile_program()
        before = _entries(cache, name)
        program = compile_program()
        # Without a new one it was in the cache before there was this file: one of those there.
        entries = _entries(cache, name) - before or before
        with suppress(OSError):  # A full disk: the next one takes the lock too.
            file.write_text(" ".join(entries) or _NO_ENTRY)
        return program


def _is_compiled(file: Path) -> bool:
    try:
        entries = file.read_text().split()
    except OSError:
        return False
    return bool(entries) and all((file.parent / entry).exists() for entry in entries)


def _hold_or_wait(file: Path, held: ExitStack) -> None:
    """Takes the lock until `held` is closed, if that is possible.

    If another process has it, nothing is taken: this returns when that one has released it, or
    after `LONGEST_WAIT_S`.
    """
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        # For writing: network file systems lock no others.
        fd = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        held.callback(os.close, fd)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with ExitStack() as waiting:
                for on_wait in ON_WAIT:
                    waiting.enter_context(on_wait())
                _wait(fd)


def _wait(fd: int) -> None:
    """Returns when the lock is released. Asks again and again: `flock` knows no time limit."""
    deadline_s = running_s() + LONGEST_WAIT_S
    while running_s() < deadline_s:
        with suppress(BlockingIOError):
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            fcntl.flock(fd, fcntl.LOCK_UN)
            return
        time.sleep(_POLL_S)


def _entries(cache: Path, name: str) -> set[str]:
    return {entry.name for entry in cache.glob(f"{name}-*-cache")}
