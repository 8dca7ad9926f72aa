"""From updates and the agents' reports to lines of metrics.

PPS, predictions per second: environment steps that agents have acted upon. TTOP, training
samples per second: environment steps that trainers have learnt from (paper, section 6).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from gmijax.a3c.board import Report
from gmijax.a3c.losses import LossMetrics
from gmijax.a3c.rollout import stats_example
from gmijax.a3c.staleness import MAX_COUNTED, mean_and_p99
from gmijax.a3c.tally import Tally
from gmijax.metrics import Episodes, EpisodeWindow, MetricsLog
from gmijax.physics_health import OverflowCount, check_diverged, overflow_line
from gmijax.sim.wrappers import BatchedEnv

_OF_RATES: Mapping[str, Callable[[Any], Any]] = MappingProxyType(
    {"mean": np.mean, "min": np.min, "max": np.max}
)
"""How figures of several updates are joined to those of a line."""

LINE_EVERY_S = 0.5
"""Updates may be much faster than anybody can read: a line tells of all since the one before."""


class Progress(NamedTuple):
    """Where the job is when a line is written.

    Attributes:
      env_steps: consumed by trainers.
      reports: the newest of every agent.
      learning_rate: after the last update.
      noise_std: mean standard deviation of the policy.
    """

    env_steps: int
    reports: tuple[Report, ...]
    learning_rate: float
    noise_std: float


class Told(NamedTuple):
    """What an update tells.

    Attributes:
      losses: on the host.
      rates: likewise, see `rate_figures`.
      update_s: seconds that it took.
    """

    losses: LossMetrics
    rates: dict[str, Any]
    update_s: float


class _Sums(NamedTuple):
    """Over all agents since they started."""

    env_steps: float
    bytes_sent: float
    dropped: float
    send_s: float
    wait_s: float
    stats: Any


class Reporter:
    """Turns updates into lines, a line for half a second of them, and notices bad numbers.

    Attributes:
      pps: predictions per second of every line.
      ttop: training samples per second of every line.
      bytes_per_s: of experience, of every line.
      dropped: pieces of experience that were dropped for lack of room.
      last_return: mean return of the latest episodes, None while none has ended.
      overflows: environment steps for which a buffer of the simulator was too small.
    """

    def __init__(
        self, env_name: str, log: MetricsLog, env: BatchedEnv, *, env_steps: int, wall_s: float
    ) -> None:
        """Starts at `env_steps` and `wall_s` of training, those of the resumed run if any."""
        self._env_name = env_name
        self._log = log
        zeros, self._unpack = ravel_pytree(stats_example(env.spec, env.overflows))
        self._before = _Sums(0.0, 0.0, 0.0, 0.0, 0.0, np.zeros(zeros.size))
        self._window = EpisodeWindow()
        self._env_steps = env_steps
        self._last = time.monotonic()
        self._started = self._last - wall_s
        self._updates: list[tuple[Told, float]] = []
        self._stale = 0.0
        self._recent = np.zeros(MAX_COUNTED + 1, np.float32)
        self._whole = np.zeros(MAX_COUNTED + 1, np.float64)
        self.pps: list[float] = []
        self.ttop: list[float] = []
        self.bytes_per_s: list[float] = []
        self.dropped = 0
        self.last_return: float | None = None
        self.overflows = OverflowCount(env_name)

    @property
    def is_due(self) -> bool:
        """Whether the last line is old enough."""
        return time.monotonic() - self._last >= LINE_EVERY_S

    def add(self, tally: Tally, told: Told) -> None:
        """Takes in one update."""
        self._updates.append((told, tally.receive_s))
        self._stale += tally.stale
        self._recent += tally.staleness

    def staleness(self) -> dict[str, float] | None:
        """Mean and 99th percentile of versions behind over the whole run."""
        figures = mean_and_p99(self._whole + self._recent)
        return None if figures is None else {"mean": figures[0], "p99": figures[1]}

    def write(self, progress: Progress) -> None:
        """Writes the line of the updates since the last one; nothing if there were none.

        Raises:
          NonFiniteError: too many steps of the agents diverged.
        """
        if not self._updates:
            return
        now = time.monotonic()
        duration = now - self._last
        sums = _total(progress.reports, self._before)
        packed = (sums.stats - self._before.stats).astype(np.float32)
        stats: Any = jax.tree.map(float, self._unpack(packed))
        predictions = sums.env_steps - self._before.env_steps
        where = f"{self._env_name}, up to env step {progress.env_steps}"
        check_diverged(where, stats.diverged, predictions)
        self.overflows.add(stats.overflowed)
        episodes: Any = stats.episodes
        self._window.add(Episodes(**episodes._asdict()))
        means = self._window.means()
        self.last_return = means["return"]
        self.dropped = int(sums.dropped)
        consumed = progress.env_steps - self._env_steps
        self.pps.append(predictions / duration)
        self.ttop.append(consumed / duration)
        self.bytes_per_s.append((sums.bytes_sent - self._before.bytes_sent) / duration)
        self._log.write(
            {
                "env_steps": progress.env_steps,
                "wall_s": now - self._started,
                "env_steps_per_s": self.ttop[-1],
                **means,
                "diverged_steps": stats.diverged["any"],
                **overflow_line(stats.overflowed),
                "reward_per_step": stats.reward_sum / predictions if predictions else None,
                **self._of_updates(),
                "policy/learning_rate": progress.learning_rate,
                "policy/noise_std": progress.noise_std,
                **self._of_experience(progress, sums),
            }
        )
        self._before, self._last, self._env_steps = sums, now, progress.env_steps
        self._updates.clear()
        self._whole += self._recent
        self._recent[:] = 0.0
        self._stale = 0.0

    def close(self) -> None:
        """Flushes the log."""
        self._log.close()

    def _of_updates(self) -> dict[str, float]:
        told, receive_s = zip(*self._updates, strict=True)
        losses, rates, update_s = zip(*told, strict=True)
        return {
            **{
                f"loss/{name}": float(np.mean([getattr(one, name) for one in losses]))
                for name in LossMetrics._fields
                if name != "weight"  # 1, over a batch.
            },
            **{
                f"policy/learning_rate_{name}": float(joined([one[name] for one in rates]))
                for name, joined in _OF_RATES.items()
                if name in rates[0]
            },
            "async/updates": len(self._updates),
            "time/update_s": float(np.mean(update_s)),
            "time/receive_s": float(np.mean(receive_s)),
        }

    def _of_experience(self, progress: Progress, sums: _Sums) -> dict[str, float | None]:
        mean, p99 = mean_and_p99(self._recent) or (None, None)
        return {
            "async/pps": self.pps[-1],
            "async/ttop": self.ttop[-1],
            "async/staleness_mean": mean,
            "async/staleness_p99": p99,
            "async/stale_unrolls": self._stale,
            "channel/occupancy": max((r.occupancy for r in progress.reports), default=None),
            "channel/bytes_per_s": self.bytes_per_s[-1],
            "channel/dropped": sums.dropped - self._before.dropped,
            "time/send_s": sums.send_s - self._before.send_s,
            "time/wait_s": sums.wait_s - self._before.wait_s,
        }


def _total(reports: tuple[Report, ...], before: _Sums) -> _Sums:
    """Sums over agents; those of the last line while none has reported."""
    if not reports:
        return before
    return _Sums(
        env_steps=sum(r.env_steps for r in reports),
        bytes_sent=sum(r.bytes_sent for r in reports),
        dropped=sum(r.dropped for r in reports),
        send_s=sum(r.send_s for r in reports),
        wait_s=sum(r.wait_s for r in reports),
        stats=np.sum([r.stats for r in reports], axis=0),
    )
