"""From an iteration's arrays to a line of metrics."""

from __future__ import annotations

import time

import jax

from gmijax.errors import NonFiniteError
from gmijax.metrics import Episodes, EpisodeWindow, MetricsLog
from gmijax.ppo.programs import IterationMetrics


class Reporter:
    """Turns the metrics of iterations into lines, and notices what is not finite.

    Attributes:
      iteration_s: seconds between the ends of consecutive iterations.
      last_return: mean return of the latest episodes, None while none has ended.
    """

    def __init__(self, env_name: str, log: MetricsLog, env_steps: int) -> None:
        self._env_name = env_name
        self._log = log
        self._window = EpisodeWindow()
        self._env_steps = env_steps
        self._started = self._last = time.monotonic()
        self.iteration_s: list[float] = []
        self.last_return: float | None = None

    def report(self, env_steps: int, metrics: IterationMetrics) -> None:
        """Waits for the iteration that ended at `env_steps` and writes its line.

        Raises:
          NonFiniteError: an observation, a reward or a loss is NaN or infinite.
        """
        host: IterationMetrics = jax.tree.map(float, metrics._replace(stats=_scalars(metrics)))
        now = time.monotonic()
        self._check_finite(host, env_steps)
        episodes = host.stats.episodes
        self._window.add(
            Episodes(
                episodes.count, episodes.return_sum, episodes.length_sum, episodes.term_sums
            )
        )
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
                "reward_per_step": host.stats.reward_sum / steps,
                **{f"loss/{name}": value for name, value in host.losses._asdict().items()},
                "policy/learning_rate": host.learning_rate,
                "policy/noise_std": host.noise_std,
            }
        )
        self._last, self._env_steps = now, env_steps

    def close(self) -> None:
        """Flushes the log."""
        self._log.close()

    def _check_finite(self, host: IterationMetrics, env_steps: int) -> None:
        where = f"{self._env_name}, up to env step {env_steps}"
        if bad := host.stats.nonfinite_obs:
            raise NonFiniteError(f"{where}: {bad:.0f} steps gave a non-finite observation")
        if bad := host.stats.nonfinite_reward:
            raise NonFiniteError(f"{where}: {bad:.0f} steps gave a non-finite reward")
        losses = host.losses._asdict()
        if names := [name for name, value in losses.items() if not abs(value) < float("inf")]:
            raise NonFiniteError(f"{where}: {', '.join(names)} of the update is not finite")


def _scalars(metrics: IterationMetrics) -> object:
    # The moments have O numbers each and are of no use in a log.
    zero = 0.0
    return metrics.stats._replace(obs=zero, advantage=zero)
