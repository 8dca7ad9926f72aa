"""The outcome of episodes, and its form in `returns.json`. No jax here."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.config import PlayConfig
from gmijax.sim.trajectory import Trajectory, chosen


class Episodes(NamedTuple):
    """Outcome of N episodes.

    Attributes:
      returns: [N] undiscounted returns.
      lengths: [N] steps.
      terminated: [N] bool, ended by the task.
      truncated: [N] bool, ended by the time limit; neither means cut off.
      diverged: [N] bool, terminated because of a bad number (see `gmijax.sim.divergence`).
      terms: [N] each, what every reward term added to the returns.
      metrics: [N] each, the task's metrics at the end.
      qpos: [L + 1, E, nq] positions of the first E environments, from the start to the end of the
        longest of their episodes; L is that episode's length. For pictures: see `Env.qpos`.
      compile_s: seconds that tracing and compiling took.
      run_s: seconds of simulation.
    """

    returns: npt.NDArray[np.float32]
    lengths: npt.NDArray[np.int32]
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]
    diverged: npt.NDArray[np.bool_]
    terms: dict[str, npt.NDArray[np.float32]]
    metrics: dict[str, npt.NDArray[np.float32]]
    qpos: npt.NDArray[np.float32]
    compile_s: float
    run_s: float

    def filmed(self, control_dt_s: float, *, count: int, title: str, command: str) -> Trajectory:
        """Those that a film shows; see `gmijax.sim.trajectory.chosen`."""
        return chosen(
            self.qpos,
            self.lengths,
            self.returns,
            control_dt_s,
            count=count,
            title=title,
            command=command,
        )


def summarise(
    config: PlayConfig, env_name: str, env_steps: int | None, episodes: Episodes
) -> dict[str, Any]:
    """The content of `returns.json`, without the device."""
    num_envs = len(episodes.returns)
    ended = episodes.terminated | episodes.truncated
    return {
        "env": env_name,
        "checkpoint": str(config.checkpoint),
        "env_steps": env_steps,
        "num_envs": num_envs,
        "seed": config.seed,
        "deterministic": config.deterministic,
        "max_steps": config.max_steps,
        "return": statistics(episodes.returns),
        "length": statistics(episodes.lengths),
        "terms": {name: statistics(sums) for name, sums in episodes.terms.items()},
        "metrics": {name: statistics(values) for name, values in episodes.metrics.items()},
        "num_terminated": int(episodes.terminated.sum()),
        "num_truncated": int(episodes.truncated.sum()),
        "num_cut_off": int((~ended).sum()),
        "num_diverged": int(episodes.diverged.sum()),
        "compile_s": episodes.compile_s,
        "run_s": episodes.run_s,
        "episodes": [
            {
                "return": float(episodes.returns[i]),
                "length": int(episodes.lengths[i]),
                "terminated": bool(episodes.terminated[i]),
                "truncated": bool(episodes.truncated[i]),
                "diverged": bool(episodes.diverged[i]),
                "terms": {name: float(sums[i]) for name, sums in episodes.terms.items()},
                "metrics": {name: float(values[i]) for name, values in episodes.metrics.items()},
            }
            for i in range(num_envs)
        ],
    }


def statistics(values: npt.NDArray[np.generic]) -> dict[str, float]:
    """Mean, standard deviation (of the population), least and greatest of `values` [N]."""
    return {name: float(getattr(values, name)()) for name in ("mean", "std", "min", "max")}
