"""Statistics of a rollout, which GMIs exchange before they learn from it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gmijax.config import PpoConfig
from gmijax.learning.normalize import (
    Moments,
    merge_all,
    moments_of,
    moments_of_those,
    no_samples,
    without_outliers,
)
from gmijax.learning.unroll import Counts, merge_counts, no_counts
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import StepOutput
from gmijax.types import Array


class RolloutStats(NamedTuple):
    """Statistics of a rollout that GMIs exchange; see `merge_stats`.

    Attributes:
      obs: moments of the raw observations, [O].
      advantage: moments of the advantages, [].
      target: moments of the value function's targets, [].
      counts: sums over all steps.
    """

    obs: Moments
    advantage: Moments
    target: Moments
    counts: Counts


def obs_moments(config: PpoConfig, moments: Moments, obs: Array, out: StepOutput) -> Moments:
    """Statistics of the raw observations [T, N, O] that led to `out`.

    `moments` are those of all observations before, by which outliers are recognised.
    """
    if config.obs_outliers == "diverged":
        ended = out.terminated | out.truncated
        return moments_of_those(~until_diverged(out.is_diverged, ended), obs)
    return moments_of(without_outliers(moments, obs), 2)


def until_diverged(is_diverged: Array, ended: Array) -> Array:
    """Which steps [T, N] belong to an episode that ends later on because its environment diverged.

    Long before a number leaves all bounds it is thousands of times the usual.
    """

    def back(later: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        bad, over = step
        wild = bad | (later & ~over)
        return wild, wild

    none = jnp.zeros_like(ended[0])
    return jax.lax.scan(back, none, (is_diverged, ended), reverse=True)[1]


def merge_stats(stacked: RolloutStats) -> RolloutStats:
    """Statistics of all GMIs together; every leaf of `stacked` has a leading axis [K]."""
    return RolloutStats(
        merge_all(stacked.obs),
        merge_all(stacked.advantage),
        merge_all(stacked.target),
        merge_counts(stacked.counts),
    )


def no_stats(spec: EnvSpec, overflows: tuple[str, ...] = ()) -> RolloutStats:
    """Zeros in the structure of `RolloutStats`."""
    obs, one = no_samples((spec.obs_size,)), no_samples(())
    return RolloutStats(obs, one, one, no_counts(spec, overflows))
