"""Which programs of jobs the compilation cache holds, so that nobody has to wait for them."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

from gmijax.supervise.start_gmi import program_cache
from gmijax.version import __version__, versions_of

_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx")


class CompiledPrograms:
    """Programs (`Job.program`) that a job of this or of an earlier sweep has compiled here.

    Each is an empty file in the compilation cache, and goes when that is emptied. One that is
    wrong (another GPU, other sources) costs time: jobs then compile the same at the same time.
    """

    def __init__(self) -> None:
        self._folder = program_cache()
        self._versions = repr((__version__, versions_of(_PACKAGES)))
        self._own: set[str] = set()

    def holds(self, program: str) -> bool:
        """Whether the programs of such jobs are in the cache."""
        return program in self._own or self._file(program).exists()

    def add(self, program: str, *, is_lasting: bool) -> None:
        """Nobody has to wait for these programs; in later sweeps too, if that is lasting."""
        self._own.add(program)
        if is_lasting:
            with suppress(OSError):  # A full disk must not end the sweep.
                self._folder.mkdir(parents=True, exist_ok=True)
                self._file(program).touch()

    def _file(self, program: str) -> Path:
        key = f"{self._versions} {program}".encode()
        return self._folder / f"gmijax-job-{hashlib.sha256(key).hexdigest()}"
