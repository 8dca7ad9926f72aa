"""From updates and the agents' reports to lines of metrics.

PPS, predictions per second: environment steps that agents have acted upon. TTOP, training
samples per second: environment steps that trainers have learnt from (paper, section 6).
Staleness: how many versions of the policy lie between acting and learning.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import numpy.typing as npt
from jax.flatten_util import ravel_pytree

from gmijax.a3c.a3c import A3cLosses, UpdateResult
from gmijax.a3c.job_registers import AgentReport
from gmijax.learning.training_log import TrainingLog, UpdateMetrics
from gmijax.learning.unroll import no_counts
from gmijax.sim.wrappers import BatchedEnv

MAX_COUNTED = 127
"""Any staleness above this counts as this."""

LINE_EVERY_S = 0.5
"""Updates may be much faster than anybody can read: a line is of all since the one before."""


class BatchCounts(NamedTuple):
    """Counts of the batches of all trainers for one update.

    Attributes:
      stop: how many have been asked to stop.
      fresh: unrolls that are learnt from.
      stale: unrolls that were too old, those of batches that were passed over too.
      receive_s: seconds that the last of them waited for experience.
      staleness: [MAX_COUNTED + 1] unrolls by versions behind.
    """

    stop: float
    fresh: float
    stale: float
    receive_s: float
    staleness: npt.NDArray[np.float32]


class Reporter:
    """Turns updates into lines, a line for half a second of them, from `env_steps` on.

    Of every line it keeps `pps`, `ttop` and the `bytes_per_s` of experience.
    """

    def __init__(self, log: TrainingLog, env: BatchedEnv, env_steps: int) -> None:
        self.log = log
        self.pps: list[float] = []
        self.ttop: list[float] = []
        self.bytes_per_s: list[float] = []
        zeros, unpack = ravel_pytree(no_counts(env.spec, env.overflows))
        self._unpack: Any = unpack
        self._before = AgentReport.of_nothing(zeros.size)
        self._env_steps = env_steps
        self._updates: list[tuple[UpdateResult, float, float]] = []
        self._stale = 0.0
        self._recent = np.zeros(MAX_COUNTED + 1, np.float32)
        self._whole = np.zeros(MAX_COUNTED + 1, np.float64)

    @property
    def is_due(self) -> bool:
        """Whether the last line is old enough."""
        return time.monotonic() - self.log.last_s >= LINE_EVERY_S

    def add(self, counts: BatchCounts, updated: UpdateResult, update_s: float) -> None:
        """Adds one update, of so many seconds."""
        self._updates.append((updated, update_s, counts.receive_s))
        self._stale += counts.stale
        self._recent += counts.staleness

    def staleness(self) -> dict[str, float] | None:
        """Mean and 99th percentile of versions behind over the whole run."""
        figures = mean_and_p99(self._whole + self._recent)
        return None if figures is None else {"mean": figures[0], "p99": figures[1]}

    def write(
        self, env_steps: int, reports: Sequence[AgentReport], figures: Mapping[str, float]
    ) -> None:
        """Writes the line of the updates since the last one; nothing if there were none.

        `reports` are the newest of every agent, `figures` those of the learner as it is.

        Raises:
          NonFiniteError: too many steps of the agents diverged.
        """
        if not self._updates:
            return
        now_s = time.monotonic()
        line_s = now_s - self.log.last_s
        sums = _total(reports) if reports else self._before
        stats = (sums.stats - self._before.stats).astype(np.float32)
        predictions = sums.env_steps - self._before.env_steps
        losses, rates, others = self._of_updates()
        others |= self._of_experience(sums, reports)
        self.pps.append(predictions / line_s)
        self.ttop.append((env_steps - self._env_steps) / line_s)
        self.bytes_per_s.append((sums.bytes_sent - self._before.bytes_sent) / line_s)
        others |= {
            "async/pps": self.pps[-1],
            "async/ttop": self.ttop[-1],
            "channel/bytes_per_s": self.bytes_per_s[-1],
        }
        self.log.write(
            env_steps,
            jax.tree.map(float, self._unpack(stats)),
            UpdateMetrics(losses, figures, rates),
            others,
            simulated=predictions,
            now_s=now_s,
        )
        self._before, self._env_steps = sums, env_steps
        self._updates.clear()
        self._whole += self._recent
        self._recent[:] = 0.0
        self._stale = 0.0

    def _of_updates(self) -> tuple[dict[str, float], dict[str, float], dict[str, Any]]:
        """Means of the losses, figures of the learning rates, and the rest."""
        updates, update_s, receive_s = zip(*self._updates, strict=True)
        _, losses, rates, explained = zip(*updates, strict=True)
        averaged: Any = np.mean(losses, axis=0, dtype=np.float64)
        means = dict(zip(A3cLosses._fields, map(float, averaged), strict=True))
        del means["weight"]  # 1, over a batch.
        # As their names say: the mean of the means, the least and the largest of all.
        joined = {
            name: float(getattr(np, name)([one[name] for one in rates])) for name in rates[0]
        }
        return (
            means,
            joined,
            {
                "value/explained_variance": float(np.mean(explained)),
                "async/updates": len(self._updates),
                "time/update_s": float(np.mean(update_s)),
                "time/receive_s": float(np.mean(receive_s)),
            },
        )

    def _of_experience(
        self, sums: AgentReport, reports: Sequence[AgentReport]
    ) -> dict[str, float | None]:
        mean, p99 = mean_and_p99(self._recent) or (None, None)
        return {
            "async/staleness_mean": mean,
            "async/staleness_p99": p99,
            "async/stale_unrolls": self._stale,
            "channel/occupancy": max((r.occupancy for r in reports), default=None),
            "time/send_s": sums.send_s - self._before.send_s,
            "time/wait_s": sums.wait_s - self._before.wait_s,
        }


def histogram_of(versions_behind: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
    """[MAX_COUNTED + 1]: how many are so many versions behind."""
    clipped = np.clip(versions_behind, 0, MAX_COUNTED)
    return np.bincount(clipped, minlength=MAX_COUNTED + 1).astype(np.float32)


def mean_and_p99(histogram: npt.NDArray[np.floating]) -> tuple[float, float] | None:
    """Mean and 99th percentile of versions behind; None while there are none.

    The percentile is the smallest number that at least 99 % do not exceed.
    """
    total = float(histogram.sum())
    if not total:
        return None
    behind = np.arange(len(histogram))
    p99 = int(np.searchsorted(np.cumsum(histogram), 0.99 * total - 1e-6))
    return float(histogram @ behind) / total, float(behind[min(p99, len(behind) - 1)])


def _total(reports: Sequence[AgentReport]) -> AgentReport:
    """Sums over agents, since they started."""
    numbers = zip(*(report[1:-1] for report in reports), strict=True)
    stats = np.sum([report.stats for report in reports], axis=0)
    return AgentReport._make([None, *map(sum, numbers), stats])
