"""One process compiles a program, others with the same compilation cache wait and load it.

Every program has a file in the cache that its compiler holds by `flock`. The kernel releases it
when the process ends, however it ends, and the next one compiles. Once it is compiled the file
names its entries in the cache. While these are there nobody takes the lock, so that all load at
the same time.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from typing import Final, TypeVar

T = TypeVar("T")

ON_WAIT: Final[list[Callable[[], AbstractContextManager[None]]]] = []
"""Entered by this process while it waits for another one."""

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
        if _is_compiled(file) or not _hold(file, held) or _is_compiled(file):
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


def _hold(file: Path, held: ExitStack) -> bool:
    """Takes the lock until `held` is closed; whether that is possible."""
    try:
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
                fcntl.flock(fd, fcntl.LOCK_EX)
    except OSError:
        return False
    return True


def _entries(cache: Path, name: str) -> set[str]:
    return {entry.name for entry in cache.glob(f"{name}-*-cache")}
