"""Entries of the compilation cache that cannot be read, and what becomes of them. No jax here.

JAX writes an entry in place and never writes over one that is there. A process that is killed
meanwhile, or a full disk, leaves half an entry: every GMI of every later job would then compile
that program by itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

_BROKEN = re.compile(r"Error reading persistent compilation cache entry for '([\w.<>-]+)'")
"""The warning of JAX; it names the program, not the file."""


def drop_broken_programs(cache: Path, logs: Iterable[Path]) -> int:
    """Removes entries of programs that GMIs could not read, so that the next job writes them.

    Args:
      cache: the folder, `JAX_COMPILATION_CACHE_DIR` of the GMIs.
      logs: stderr of the GMIs.

    Returns:
      The number of files removed: all entries of these programs, good ones too.
    """
    names: set[str] = set()
    for log in logs:
        with suppress(OSError):
            names.update(_BROKEN.findall(log.read_text(errors="replace")))
    removed = 0
    for name in names:
        for entry in cache.glob(f"{name}-*"):
            with suppress(OSError):
                entry.unlink()
                removed += 1
    return removed
