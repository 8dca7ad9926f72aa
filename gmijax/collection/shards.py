"""Writes experience as shards, while the next one is collected."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gmijax.collection.programs import Step
from gmijax.datadir import DataPaths
from gmijax.rundir import write_json


class ShardWriter:
    """Writes the shards of one GMI in order, one at a time, in a thread.

    Attributes:
      num_written: shards that are finished and safe, by this writer.
      num_bytes: their size.
    """

    def __init__(
        self, paths: DataPaths, rank: int, first: int, about: Mapping[str, Any], *, compress: bool
    ) -> None:
        """Begins at shard `first`; `about` goes into the JSON file of every shard."""
        self.num_written = self.num_bytes = 0
        self._paths = paths
        self._rank = rank
        self._first = self._next = first
        self._about = dict(about)
        self._save: Callable[..., None] = np.savez_compressed if compress else np.savez
        self._pool = ThreadPoolExecutor(1, "shards")
        self._pending: Future[int] | None = None
        paths.folder(rank).mkdir(parents=True, exist_ok=True)
        for left in paths.folder(rank).glob(".[0-9]*"):  # Of arrays, and of their JSON files.
            left.unlink()

    def write(self, steps: Step) -> None:
        """Takes one unroll [T, N]; waits for the one before, and raises what it met."""
        self.wait()
        self._pending = self._pool.submit(self._write, self._next, steps)
        self._next += 1

    def wait(self) -> None:
        """Returns when all that was taken is written.

        Raises:
          OSError: it cannot be written, e.g. because the disk is full.
        """
        if self._pending is not None:
            pending, self._pending = self._pending, None
            self.num_bytes += pending.result()
            self.num_written += 1

    def close(self) -> None:
        """Ends the thread; what is being written is finished first."""
        self._pool.shutdown()

    def _write(self, index: int, steps: Step) -> int:
        arrays = {
            name: np.asarray(array) for name, array in steps._asdict().items() if array is not None
        }
        shard = self._paths.shard(self._rank, index)
        size = _write_whole(shard.arrays, lambda file: self._save(file, **arrays))
        write_json(
            shard.about,
            {
                **self._about,
                "shard": index,
                "env_steps": int(arrays["reward"].size),
                # The environments of a job that goes on start anew; no episode spans the gap.
                "starts_with_reset": index == self._first,
                "num_bytes": size,
                "arrays": {
                    name: {"shape": list(array.shape), "dtype": str(array.dtype)}
                    for name, array in arrays.items()
                },
            },
        )
        return size


def _write_whole(path: Path, save: Callable[[BinaryIO], None]) -> int:
    """Writes a file under another name, then renames it; returns its size in bytes."""
    temporary = path.with_name(f".{path.name}.partial")
    with temporary.open("wb") as file:
        save(file)
        file.flush()
        # A crash of the machine must not leave a JSON file beside arrays that are not there.
        os.fsync(file.fileno())
        size = file.tell()
    os.replace(temporary, path)
    return size
