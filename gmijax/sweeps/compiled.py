"""Which programs of jobs the compilation cache holds, so that nobody has to wait for them."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

from gmijax.supervise.launch import program_cache
from gmijax.sweeps.jobs import Job
from gmijax.version import __version__, versions_of

_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx")


class CompiledPrograms:
    """Programs that a job of this or of an earlier sweep has compiled.

    Each is an empty file in the compilation cache, and goes when that is emptied. One that is
    wrong (another GPU, other sources) costs time: jobs then compile the same at the same time.
    """

    def __init__(self) -> None:
        self._folder = program_cache()
        self._versions = repr((__version__, versions_of(_PACKAGES)))
        self._own: set[str] = set()

    def holds(self, job: Job) -> bool:
        """Whether the programs of a job are in the cache."""
        return job.program in self._own or self._file(job).exists()

    def add(self, job: Job, *, is_lasting: bool) -> None:
        """Nobody has to wait for the job's programs; in later sweeps too, if that is lasting."""
        self._own.add(job.program)
        if is_lasting:
            with suppress(OSError):  # A full disk must not end the sweep.
                self._file(job).touch()

    def _file(self, job: Job) -> Path:
        key = f"{self._versions} {job.program}".encode()
        return self._folder / f"gmijax-job-{hashlib.sha256(key).hexdigest()}"
