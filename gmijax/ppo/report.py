"""From an iteration's arrays to a line of metrics."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from queue import SimpleQueue
from typing import Any

import jax

from gmijax.errors import NonFiniteError
from gmijax.metrics import Episodes, EpisodeWindow, MetricsLog
from gmijax.physics_health import OverflowCount, check_diverged, overflow_line
from gmijax.ppo.programs import IterationMetrics

_LAST_LINE_S = 2.0
"""Longest wait for a line when training ends, however it ends."""


class Reporter:
    """Turns the metrics of iterations into lines, and notices what is not finite.

    Attributes:
      iteration_s: seconds between the ends of consecutive iterations.
      last_return: mean return of the latest episodes, None while none has ended.
      overflows: environment steps for which a buffer of the simulator was too small.
    """

    def __init__(
        self, env_name: str, log: MetricsLog, env_steps: int, wall_s: float = 0.0
    ) -> None:
        """Starts at `env_steps` and `wall_s` of training, those of the resumed run if any."""
        self._env_name = env_name
        self._log = log
        self._window = EpisodeWindow()
        self._env_steps = env_steps
        self._last = time.monotonic()
        self._started = self._last - wall_s
        self.iteration_s: list[float] = []
        self.last_return: float | None = None
        self.overflows = OverflowCount(env_name)

    def report(
        self,
        env_steps: int,
        metrics: IterationMetrics,
        times: Mapping[str, float],
    ) -> None:
        """Waits for the iteration that ended at `env_steps` and writes its line.

        Args:
          env_steps: see above.
          metrics: of the iteration.
          times: seconds by name, written as they are.

        Raises:
          NonFiniteError: an observation, a reward or a loss is NaN or infinite.
        """
        host: Any = jax.tree.map(float, jax.device_get(metrics))
        now = time.monotonic()
        self._check_finite(host, env_steps)
        self.overflows.add(host.overflowed)
        episodes = host.episodes
        self._window.add(Episodes(**episodes._asdict()))
        means = self._window.means()
        self.last_return = means["return"]
        duration = now - self._last
        steps = env_steps - self._env_steps
        self.iteration_s.append(duration)
        self._log.write(
            {
                "env_steps": env_steps,
                "wall_s": now - self._started,
                "env_steps_per_s": steps / duration,
                **means,
                "diverged_steps": host.diverged["any"],
                **overflow_line(host.overflowed),
                "reward_per_step": host.reward_sum / steps,
                **{f"loss/{name}": value for name, value in host.losses._asdict().items()},
                "policy/learning_rate": host.learning_rate,
                **{f"policy/learning_rate_{name}": rate for name, rate in host.rates.items()},
                "policy/noise_std": host.noise_std,
                **times,
            }
        )
        self._last, self._env_steps = now, env_steps

    def close(self) -> None:
        """Flushes the log."""
        self._log.close()

    def _check_finite(self, host: Any, env_steps: int) -> None:
        where = f"{self._env_name}, up to env step {env_steps}"
        check_diverged(where, host.diverged, env_steps - self._env_steps)
        losses = host.losses._asdict()
        if names := [name for name, value in losses.items() if not abs(value) < float("inf")]:
            raise NonFiniteError(f"{where}: {', '.join(names)} of the update is not finite")


class ReportThread:
    """Reports iterations in a thread of its own, one after the other.

    To start an iteration takes the host about as long as the device takes for it. So whoever
    starts the next one notices too late that this one has ended, and the device would wait while
    its line is written.

    Args:
      reporter: is used by the thread only, until `stop`.
    """

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter
        self._queue: SimpleQueue[tuple[Any, ...] | None] = SimpleQueue()
        self._is_idle = threading.Event()
        self._is_idle.set()
        self._error: Exception | None = None
        # A daemon: a device that hangs must not keep a process alive that has failed.
        threading.Thread(target=self._run, name="report", daemon=True).start()

    def report(
        self, env_steps: int, metrics: IterationMetrics, times: Mapping[str, float]
    ) -> None:
        """See `Reporter.report`; returns when the iteration before has been reported.

        Raises:
          NonFiniteError: of that one.
        """
        self.wait()
        self._is_idle.clear()
        self._queue.put((env_steps, metrics, times))

    def wait(self) -> None:
        """Returns when all is reported; raises what was met."""
        self._is_idle.wait()
        if self._error is not None:
            raise self._error

    @property
    def last_return(self) -> float | None:
        """Of the reporter; call `wait` before."""
        return self._reporter.last_return

    def give_up(self) -> None:
        """Says that what the thread waits for will not come: `stop` does not wait for it."""
        self._is_idle.set()

    def stop(self) -> None:
        """Ends the thread, which may finish a line; calling it twice is fine."""
        self._is_idle.wait(_LAST_LINE_S)
        self._queue.put(None)

    def _run(self) -> None:
        while (waiting := self._queue.get()) is not None:
            try:
                self._reporter.report(*waiting)
            # Whatever it is, it is the caller's, who is told with the next call.
            except Exception as error:
                self._error = error
            self._is_idle.set()
