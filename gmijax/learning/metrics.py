"""Lines of metrics: one flat dict of numbers per iteration, and the files that they go to."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto import event_pb2, summary_pb2

WINDOW_EPISODES = 100
"""Means over episodes are taken over at least this many of the latest ones."""

Line = Mapping[str, float | int | None]


class EpisodeWindow:
    """Means over the latest episodes: the fewest iterations that hold WINDOW_EPISODES."""

    def __init__(self) -> None:
        self._latest: deque[Any] = deque()
        self._count = 0.0

    def add(self, episodes: Any) -> None:
        """Takes in the `EpisodeSums` of one iteration, as numbers of the host."""
        self._latest.append(episodes)
        self._count += episodes.count
        while self._count - self._latest[0].count >= WINDOW_EPISODES:
            self._count -= self._latest.popleft().count

    def means(self) -> dict[str, float | None]:
        """`return`, `episode_length`, `reward/<term>` and `metric/<name>`.

        The first two are None, and the others missing, while no episode has ended.
        """
        count = self._count
        if not count:
            return {"return": None, "episode_length": None}
        return {
            "return": sum(e.return_sum for e in self._latest) / count,
            "episode_length": sum(e.length_sum for e in self._latest) / count,
            **{
                f"reward/{name}": sum(e.term_sums[name] for e in self._latest) / count
                for name in self._latest[-1].term_sums
            },
            **{
                f"metric/{name}": sum(e.metric_sums[name] for e in self._latest) / count
                for name in self._latest[-1].metric_sums
            },
        }


class Sink(Protocol):
    """Where lines of metrics go."""

    def write(self, line: Line) -> None:
        """Takes one iteration's metrics; `env_steps` is the x axis."""
        ...

    def close(self) -> None:
        """Flushes; no write may follow."""
        ...


class JsonlSink:
    """Appends one JSON object a line; None stands for a number that is not there yet."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", buffering=1)

    def write(self, line: Line) -> None:
        """See `Sink`."""
        self._file.write(json.dumps({k: _finite(v) for k, v in line.items()}) + "\n")

    def close(self) -> None:
        """See `Sink`."""
        self._file.close()


class TensorBoardSink:
    """Writes every number as a scalar over environment steps.

    In the calling thread: the queue of tensorboardX's own writer needs /dev/shm, and blocks for
    ever once its thread has met a full disk.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._writer = EventsWriter(str(folder / "events"))
        # Made by protobuf at run time: type checkers cannot see them.
        self._event: Any = vars(event_pb2)["Event"]
        self._summary: Any = vars(summary_pb2)["Summary"]

    def write(self, line: Line) -> None:
        """See `Sink`."""
        steps = int(line["env_steps"] or 0)
        values = [
            self._summary.Value(
                tag=name if "/" in name else f"train/{name}", simple_value=float(value)
            )
            for name, value in line.items()
            if value is not None and name != "env_steps"
        ]
        summary = self._summary(value=values)
        self._writer.write_event(self._event(wall_time=time.time(), step=steps, summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """See `Sink`."""
        self._writer.close()


def _finite(value: float | int | None) -> float | int | None:
    # JSON has no NaN; a reader in another language must not choke on a diverged run.
    return None if isinstance(value, float) and not math.isfinite(value) else value
