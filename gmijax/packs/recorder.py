"""The lines of metrics that a pack keeps of a command."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from gmijax.packs.command_job import CommandJob
from gmijax.packs.progress import ProgressReader
from gmijax.runs.history import copy_history
from gmijax.supervise.start_gmi import program_cache


class Recorder:
    """Keeps the lines of metrics of a command in its folder, as a training run does.

    With the first one it makes the file `mark`, if any: what is compiled is in its caches then.
    """

    def __init__(self, reader: ProgressReader, metrics: Path, mark: Path | None) -> None:
        self._reader, self._metrics, self._mark = reader, metrics, mark
        self._is_first = True

    def new(self) -> list[dict[str, Any]]:
        """See `gmijax.sweeps.running.Reader`."""
        lines = self._reader.new()
        if not lines:
            return lines
        is_first, self._is_first = self._is_first, False
        with suppress(OSError):  # A full disk must not end the pack.
            if is_first and self._metrics.exists():
                # An attempt that continues from a checkpoint repeats some steps, or counts anew.
                copy_history(self._metrics, self._metrics, lines[0]["env_steps"] - 1)
            with self._metrics.open("a") as file:
                file.writelines(json.dumps(line) + "\n" for line in lines)
            if is_first and self._mark is not None:
                self._mark.parent.mkdir(parents=True, exist_ok=True)
                self._mark.touch()
        return lines


def mark_of(job: CommandJob, machine: str | None) -> Path:
    """The file that is there once such a job has reported anything on a machine.

    It goes when the compilation cache is emptied. One that is wrong costs time: jobs then compile
    the same at the same time.
    """
    key = hashlib.sha256(f"{machine} {job.program}".encode()).hexdigest()
    return program_cache() / f"gmijax-job-{key}"
