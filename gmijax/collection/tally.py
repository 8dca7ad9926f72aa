"""What one GMI has collected: lines for the progress display, and the outcome."""

from __future__ import annotations

import statistics
import time
from typing import Any

import jax

from gmijax.collection.programs import Counts
from gmijax.metrics import EpisodeWindow, JsonlSink
from gmijax.partition.child import ChildLink
from gmijax.physics_health import OverflowCount, check_diverged, overflow_line


class Tally:
    """Counts unrolls; the clock starts when it is made.

    Attributes:
      env_steps: environment steps so far.
      num_unrolls: unrolls so far.
    """

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
          NonFiniteError: too many worlds gave numbers that are not finite or beyond all bounds.
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
