"""Lines of metrics of a training job: one flat dict of numbers a line, and where they go."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from gmijax.learning.episode_window import EpisodeWindow, Standing
from gmijax.learning.physics_health import (
    OverflowCount,
    check_diverged,
    check_losses,
    overflow_line,
)
from gmijax.runs.folder import RunPaths, naming
from gmijax.runs.history import read_metrics, scalars
from gmijax.runs.tensorboard import Event, EventsWriter, Summary

Line: TypeAlias = Mapping[str, float | int | None]


class JsonlSink:
    """Appends one JSON object a line; None stands for a number that is not there yet."""

    def __init__(self, path: Path) -> None:
        self._path, self._file = path, path.open("a", buffering=1)

    def write(self, line: Line) -> None:
        """Takes one iteration's metrics."""
        with naming(self._path):
            self._file.write(json.dumps({k: _finite(v) for k, v in line.items()}) + "\n")

    def close(self) -> None:
        """No write may follow."""
        self._file.close()


class TensorBoardSink:
    """Writes every number as a scalar over environment steps.

    In the calling thread: the queue of tensorboardX's own writer needs /dev/shm, and blocks for
    ever once its thread has met a full disk.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._writer = EventsWriter(str(folder / "events"))

    def write(self, line: Line) -> None:
        """Takes one iteration's metrics; `env_steps` is the x axis."""
        steps = int(line["env_steps"] or 0)
        values = [Summary.Value(tag=name, simple_value=x) for name, x in scalars(line).items()]
        summary = Summary(value=values)
        self._writer.write_event(Event(wall_time=time.time(), step=steps, summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """No write may follow."""
        self._writer.close()


Sink: TypeAlias = JsonlSink | TensorBoardSink


class UpdateMetrics(NamedTuple):
    """Figures of the updates behind one line, as numbers of the host.

    Attributes:
      losses: parts of the loss by name.
      figures: others by the names that they are logged under.
      rates: of the learning rates of all updates, see `rate_figures`.
    """

    losses: Mapping[str, float]
    figures: Mapping[str, float]
    rates: Mapping[str, float]


class TrainingLog:
    """The lines of a training job, which refuse what is not finite.

    Attributes:
      last_s: time of the last line, or of the end of the pause after it.
      line_s: seconds from line to line.
      last_return: mean return of the latest episodes, None while none has ended.
      overflows: environment steps for which a buffer of the simulator was too small.
    """

    def __init__(
        self,
        env_name: str,
        sinks: Iterable[Sink],
        env_steps: int,
        wall_s: float = 0.0,
        window: EpisodeWindow | None = None,
    ) -> None:
        """Starts where the resumed run ended, if there is one.

        Args:
          env_name: for messages.
          sinks: get the lines.
          env_steps: environment steps that were learnt from before.
          wall_s: seconds of training before.
          window: the latest episodes before; None: none.
        """
        self.line_s: list[float] = []
        self.last_return: float | None = None
        self.overflows = OverflowCount(env_name)
        self.last_s = time.monotonic()
        self._env_name = env_name
        self._sinks = tuple(sinks)
        self._window = window or EpisodeWindow()
        self._env_steps = env_steps
        self._started_s = self.last_s - wall_s

    @classmethod
    def open(
        cls, env_name: str, run: RunPaths, env_steps: int, window: EpisodeWindow
    ) -> TrainingLog:
        """The log in a run folder; a resumed run starts with the lines of the one before."""
        history = read_metrics(run.metrics)
        board = TensorBoardSink(run.tensorboard)
        for line in history:
            board.write(line)
        wall_s = (history[-1].get("wall_s") or 0.0) if history else 0.0
        return cls(env_name, (JsonlSink(run.metrics), board), env_steps, wall_s, window)

    def standing(self) -> Standing:
        """How well the policy does, for a checkpoint."""
        return self._window.standing()

    def episodes(self) -> dict[str, Any]:
        """The latest episodes, for a checkpoint; see `EpisodeWindow.state`."""
        return self._window.state()

    def write(
        self,
        env_steps: int,
        counts: Any,
        learnt: UpdateMetrics,
        others: Line,
        *,
        simulated: float | None = None,
        now_s: float | None = None,
        paused_s: float = 0.0,
    ) -> None:
        """Writes a line.

        Args:
          env_steps: environment steps learnt from so far.
          counts: `Counts` of the steps simulated since the last line, as numbers of the host.
          learnt: of the updates since the last line.
          others: what else is to stand there.
          simulated: how many steps `counts` are of, None for those learnt from.
          now_s: time of the line, None for now.
          paused_s: seconds after it without training; not in the rate of the next line.

        Raises:
          NonFiniteError: too many steps diverged, or a loss is NaN or infinite.
        """
        now_s = time.monotonic() if now_s is None else now_s
        steps, line_s = env_steps - self._env_steps, now_s - self.last_s
        simulated = steps if simulated is None else simulated
        where = f"{self._env_name}, up to env step {env_steps}"
        check_diverged(where, counts.diverged, simulated)
        check_losses(where, learnt.losses)
        self.overflows.add(counts.overflowed)
        self._window.add(counts.episodes, simulated)
        means = self._window.line()
        self.last_return = means["return"]
        self.line_s.append(line_s)
        line = {
            "env_steps": env_steps,
            "wall_s": now_s - self._started_s,
            "env_steps_per_s": steps / line_s,
            **means,
            **_counted(counts, simulated),
            **_learnt(learnt),
            **others,
        }
        for sink in self._sinks:
            sink.write(line)
        self.last_s, self._env_steps = now_s + paused_s, env_steps

    def close(self) -> None:
        """Flushes the lines."""
        for sink in self._sinks:
            sink.close()


def _counted(counts: Any, simulated: float) -> Line:
    return {
        "diverged_steps": counts.diverged["any"],
        **overflow_line(counts.overflowed),
        "reward_per_step": counts.reward_sum / simulated if simulated else None,
    }


def _learnt(learnt: UpdateMetrics) -> Line:
    return {
        **{f"loss/{name}": value for name, value in learnt.losses.items()},
        **learnt.figures,
        **{f"policy/learning_rate_{name}": rate for name, rate in learnt.rates.items()},
    }


def _finite(value: float | int | None) -> float | int | None:
    # JSON has no NaN; a reader in another language must not choke on a diverged run.
    return None if isinstance(value, float) and not math.isfinite(value) else value
