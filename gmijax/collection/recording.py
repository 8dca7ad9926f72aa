"""What a serving GMI keeps: experience as shards, statistics as lines for the progress display."""

from __future__ import annotations

import io
import statistics
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from gmijax.collection.programs import CollectedStep
from gmijax.learning.episode_window import EpisodeWindow
from gmijax.learning.physics_health import OverflowCount, check_diverged, overflow_line
from gmijax.learning.training_log import JsonlSink
from gmijax.learning.unroll import Counts
from gmijax.runs.dataset import DataPaths
from gmijax.runs.folder import remove_temporary, write_bytes, write_json
from gmijax.supervise.child import ChildLink


class ShardWriter:
    """Writes the shards of one GMI in order, in a thread, while the next unroll is made.

    `num_written` of them, of `num_bytes` in all, are finished and safe.
    """

    def __init__(self, paths: DataPaths, rank: int, first: int, about: Mapping[str, Any]) -> None:
        """Begins at shard `first`; `about` goes into the JSON file of every shard."""
        self.num_written = self.num_bytes = 0
        self._paths = paths
        self._rank = rank
        self._first = self._next = first
        self._about = dict(about)
        self._pool = ThreadPoolExecutor(1, "shards")
        self._pending: Future[int] | None = None
        paths.folder(rank).mkdir(exist_ok=True)
        remove_temporary(paths.folder(rank))

    def write(self, steps: CollectedStep) -> None:
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

    def _write(self, index: int, steps: CollectedStep) -> int:
        arrays = {
            name: np.asarray(array) for name, array in steps._asdict().items() if array is not None
        }
        shard = self._paths.shard(self._rank, index)
        content = io.BytesIO()
        save: Callable[..., None] = np.savez  # For pyright, an array may be called `allow_pickle`.
        save(content, **arrays)
        # On the disk before its JSON file, which marks the shard as complete.
        write_bytes(shard.arrays, content.getvalue())
        write_json(
            shard.about,
            {
                **self._about,
                "shard": index,
                "env_steps": int(arrays["reward"].size),
                # The environments of a continued job start anew; no episode spans the gap.
                "starts_with_reset": index == self._first,
                "num_bytes": content.tell(),
                "arrays": {
                    name: {"shape": list(array.shape), "dtype": str(array.dtype)}
                    for name, array in arrays.items()
                },
            },
        )
        return content.tell()


class CollectionStats:
    """Counts unrolls and environment steps; the clock starts when it is made."""

    def __init__(self, link: ChildLink, env_name: str, steps_per_unroll: int) -> None:
        self.env_steps = self.num_unrolls = 0
        self._link = link
        self._env_name = env_name
        self._steps = steps_per_unroll
        self._window = EpisodeWindow()
        self._totals = {"count": 0.0, "return_sum": 0.0, "length_sum": 0.0}
        self._diverged = 0.0
        self._overflows = OverflowCount(env_name)
        self._unroll_s: list[float] = []
        self._started_s = self._last_s = time.monotonic()
        self._lines = JsonlSink(link.paths.metrics)

    def add(self, counts: Counts) -> None:
        """Waits for an unroll and takes it in.

        Raises:
          NonFiniteError: too many environments gave numbers that are not finite or beyond all
            bounds.
        """
        host: Any = jax.tree.map(float, jax.device_get(counts))
        now_s = time.monotonic()
        self._unroll_s.append(now_s - self._last_s)
        self._last_s = now_s
        self.env_steps += self._steps
        self.num_unrolls += 1
        where = f"{self._env_name}, up to env step {self.env_steps} of this GMI"
        check_diverged(where, host.diverged, self._steps)
        self._diverged += host.diverged["any"]
        self._overflows.add(host.overflowed)
        episodes = host.episodes
        self._window.add(episodes)
        for name in self._totals:
            self._totals[name] += getattr(episodes, name)
        means = self._window.means()
        self._lines.write(
            {
                "env_steps": self.env_steps,
                "wall_s": now_s - self._started_s,
                "env_steps_per_s": self._steps / self._unroll_s[-1],
                "return": means["return"],
                "episode_length": means["episode_length"],
                "episodes": self._totals["count"],
                "diverged_steps": self._diverged,
                **overflow_line(host.overflowed),
            }
        )
        self._link.beat("running", self.num_unrolls)

    def close(self) -> None:
        """Flushes the lines."""
        self._lines.close()

    def outcome(self) -> dict[str, Any]:
        """What this GMI has collected, for `result.json`."""
        wall_s = self._last_s - self._started_s
        steady = self._unroll_s[1:] or self._unroll_s
        return {
            "env_steps": self.env_steps,
            "unrolls": self.num_unrolls,
            "serve_wall_s": wall_s,
            "env_steps_per_s": self.env_steps / wall_s if self.env_steps else None,
            # The first unroll fills caches and pools.
            "step_per_s_inference": self._steps / statistics.median(steady) if steady else None,
            "episodes": self._totals,
            "diverged_steps": self._diverged,
            "overflow_steps": self._overflows.steps,
        }
