"""Lines of metrics of a training job."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from gmijax.learning.metrics import EpisodeWindow, JsonlSink, Line, Sink, TensorBoardSink
from gmijax.learning.physics_health import (
    OverflowCount,
    check_diverged,
    check_losses,
    overflow_line,
)
from gmijax.runs.folder import RunPaths
from gmijax.runs.history import read_metrics


class Learnt(NamedTuple):
    """Figures of the updates behind one line, as numbers of the host.

    Attributes:
      losses: parts of the loss by name.
      learning_rate: after the last update.
      rates: of all updates, see `rate_figures`.
      noise_std: mean standard deviation of the policy.
    """

    losses: Mapping[str, float]
    learning_rate: float
    rates: Mapping[str, float]
    noise_std: float


class TrainingLog:
    """The lines of a training job, which refuse what is not finite.

    Attributes:
      last_s: time of the last line.
      line_s: seconds from line to line.
      last_return: mean return of the latest episodes, None while none has ended.
      overflows: environment steps for which a buffer of the simulator was too small.
    """

    def __init__(
        self, env_name: str, sinks: Iterable[Sink], env_steps: int, wall_s: float = 0.0
    ) -> None:
        """Starts at `env_steps` and `wall_s` of training, those of the resumed run if any."""
        self.line_s: list[float] = []
        self.last_return: float | None = None
        self.overflows = OverflowCount(env_name)
        self.last_s = time.monotonic()
        self._env_name = env_name
        self._sinks = tuple(sinks)
        self._window = EpisodeWindow()
        self._env_steps = env_steps
        self._started_s = self.last_s - wall_s

    @classmethod
    def open(cls, env_name: str, run: RunPaths, env_steps: int) -> TrainingLog:
        """The log in a run folder; a resumed run starts with the lines of the one before."""
        history = read_metrics(run.metrics)
        board = TensorBoardSink(run.tensorboard)
        for line in history:
            board.write(line)
        wall_s = history[-1]["wall_s"] if history else 0.0
        return cls(env_name, (JsonlSink(run.metrics), board), env_steps, wall_s)

    def write(
        self,
        env_steps: int,
        counts: Any,
        learnt: Learnt,
        others: Line,
        *,
        simulated: float | None = None,
        now_s: float | None = None,
    ) -> None:
        """Writes a line.

        Args:
          env_steps: environment steps learnt from so far.
          counts: `Counts` of the steps simulated since the last line, as numbers of the host.
          learnt: of the updates since the last line.
          others: what else is to stand there.
          simulated: how many steps `counts` are of, None for those learnt from.
          now_s: time of the line, None for now.

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
        self._window.add(counts.episodes)
        means = self._window.means()
        self.last_return = means["return"]
        self.line_s.append(line_s)
        line = {
            "env_steps": env_steps,
            "wall_s": now_s - self._started_s,
            "env_steps_per_s": steps / line_s,
            **means,
            "diverged_steps": counts.diverged["any"],
            **overflow_line(counts.overflowed),
            "reward_per_step": counts.reward_sum / simulated if simulated else None,
            **{f"loss/{name}": value for name, value in learnt.losses.items()},
            "policy/learning_rate": learnt.learning_rate,
            **{f"policy/learning_rate_{name}": rate for name, rate in learnt.rates.items()},
            "policy/noise_std": learnt.noise_std,
            **others,
        }
        for sink in self._sinks:
            sink.write(line)
        self.last_s, self._env_steps = now_s, env_steps

    def close(self) -> None:
        """Flushes the lines."""
        for sink in self._sinks:
            sink.close()
