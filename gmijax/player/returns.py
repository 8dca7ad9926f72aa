"""Whole episodes of a policy in plain MuJoCo: what they return, and how they moved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.player.outcome import Episodes
from gmijax.player.plain_env import PlainEnv, task_of
from gmijax.player.policy import PlainPolicy

Floats: TypeAlias = npt.NDArray[np.float32]


class Played(NamedTuple):
    """One episode.

    Attributes:
      qpos: [L + 1, nq] positions from the start on.
      return_: the sum of its rewards.
      terms: what every term added to it.
      metrics: what it had reached at its end.
      terminated: it ended by itself.
      truncated: time ran out.
      diverged: it ended because of a bad number.
    """

    qpos: Floats
    return_: float
    terms: dict[str, float]
    metrics: dict[str, float]
    terminated: bool
    truncated: bool
    diverged: bool

    @property
    def length(self) -> int:
        """L, in control steps."""
        return len(self.qpos) - 1


def play(
    policy: PlainPolicy, num_episodes: int, seed: int, max_steps: int | None = None
) -> Iterator[Played]:
    """Episodes of the task that the policy was trained for, without noise, one after the other.

    Args:
      policy: of one of our own tasks.
      num_episodes: how many.
      seed: of their starts.
      max_steps: where they are cut off; None: only the task ends them.

    Raises:
      ConfigError: see `PlainEnv`.
    """
    env = PlainEnv(task_of(policy), seed)
    for number in range(num_episodes):
        if number:
            env.reset()
        yield _episode(env, policy, max_steps)


def _episode(env: PlainEnv, policy: PlainPolicy, max_steps: int | None) -> Played:
    qpos, terms, total = [env.qpos], dict.fromkeys(env.spec.reward_terms, 0.0), 0.0
    while True:
        step = env.step(policy(env.obs))
        qpos.append(env.qpos)
        total += step.reward
        for name, value in step.terms.items():
            terms[name] += value
        if step.terminated or step.truncated or env.steps == max_steps:
            ended = step.terminated, step.truncated, env.diverged
            return Played(np.stack(qpos), total, terms, env.metrics, *ended)


def together(episodes: Sequence[Played], run_s: float) -> Episodes:
    """The episodes side by side; environments whose episode is over stand still."""
    longest = max(one.length for one in episodes)

    def column(name: str) -> npt.NDArray[np.float32]:
        return np.array([getattr(one, name) for one in episodes], np.float32)

    def columns(name: str) -> dict[str, npt.NDArray[np.float32]]:
        rows = [getattr(one, name) for one in episodes]
        return {key: np.array([row[key] for row in rows], np.float32) for key in rows[0]}

    padded = [np.pad(one.qpos, ((0, longest - one.length), (0, 0)), "edge") for one in episodes]
    return Episodes(
        returns=column("return_"),
        lengths=column("length").astype(np.int32),
        terminated=column("terminated").astype(bool),
        truncated=column("truncated").astype(bool),
        diverged=column("diverged").astype(bool),
        terms=columns("terms"),
        metrics=columns("metrics"),
        qpos=np.stack(padded, 1),
        compile_s=0.0,
        run_s=run_s,
    )
