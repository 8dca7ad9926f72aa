"""Whole episodes of a policy in plain MuJoCo: what they return, and how they moved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.player.plain_env import PlainEnv, task_of
from gmijax.player.policy import PlainPolicy

Floats: TypeAlias = npt.NDArray[np.float32]


class Played(NamedTuple):
    """One episode.

    Attributes:
      qpos: [L + 1, nq] positions from the start on.
      return_: the sum of its rewards.
      terms: what every term added to it.
      metrics: what it had come to at its end.
      terminated: it ended by itself.
    """

    qpos: Floats
    return_: float
    terms: dict[str, float]
    metrics: dict[str, float]
    terminated: bool

    @property
    def length(self) -> int:
        """L, in control steps."""
        return len(self.qpos) - 1


def play(policy: PlainPolicy, num_episodes: int, seed: int) -> Iterator[Played]:
    """Episodes of the task that the policy was trained for, without noise, one after the other.

    Raises:
      ConfigError: see `PlainEnv`.
    """
    env = PlainEnv(task_of(policy), seed)
    for number in range(num_episodes):
        if number:
            env.reset()
        yield _episode(env, policy)


def _episode(env: PlainEnv, policy: PlainPolicy) -> Played:
    qpos, terms, total = [env.qpos], dict.fromkeys(env.spec.reward_terms, 0.0), 0.0
    while True:
        step = env.step(policy(env.obs))
        qpos.append(env.qpos)
        total += step.reward
        for name, value in step.terms.items():
            terms[name] += value
        if step.terminated or step.truncated:
            return Played(np.stack(qpos), total, terms, env.metrics, step.terminated)


def statistics(episodes: Sequence[Played]) -> dict[str, Any]:
    """Statistics over episodes as plain data: means, and the spread of returns."""
    returns = np.array([one.return_ for one in episodes])
    names = episodes[0].metrics
    return {
        "episodes": len(episodes),
        "return": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_median": float(np.median(returns)),
        "return_quartiles": [float(x) for x in np.quantile(returns, (0.25, 0.75))],
        "length": float(np.mean([one.length for one in episodes])),
        "terminated": sum(one.terminated for one in episodes),
        **{name: float(np.mean([one.metrics[name] for one in episodes])) for name in names},
    }
