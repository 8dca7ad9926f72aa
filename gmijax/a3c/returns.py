"""Targets of values and advantages: n-step returns, and V-trace for steps of older policies."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gmijax.types import Array


class Returns(NamedTuple):
    """Targets for the networks, [T, N] each.

    Attributes:
      value: the target of the value function.
      advantage: how much better the action was than expected.
      rho: weight of a step in the policy gradient, 1 where nothing is corrected.
    """

    value: Array
    advantage: Array
    rho: Array


def n_step_returns(
    rewards: Array,
    values: Array,
    next_values: Array,
    terminated: Array,
    truncated: Array,
    *,
    discount: float,
) -> Returns:
    """Returns over what is left of the unroll (A3C, Mnih et al. 2016, arXiv:1602.01783).

        R_t = r_t + discount * (1 - terminated_t) * (R_{t+1} or, at an end, V(s_{t+1}))

    All arrays are [T, N]. `next_values[t]` is V(s_{t+1}) before any auto-reset: the last step
    and a truncated one bootstrap from it, a terminated one does not.
    """

    def back(later: Array, step: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        reward, next_value, ended, cut = step
        total = reward + discount * (1.0 - ended) * jnp.where(cut > 0, next_value, later)
        return total, total

    steps = (rewards, next_values, terminated, truncated)
    total = jax.lax.scan(back, next_values[-1], steps, reverse=True)[1]
    return Returns(value=total, advantage=total - values, rho=jnp.ones_like(values))


def vtrace(
    rewards: Array,
    values: Array,
    next_values: Array,
    terminated: Array,
    truncated: Array,
    ratios: Array,
    *,
    discount: float,
    lam: float,
    rho_clip: float,
    trace_clip: float,
) -> Returns:
    """V-trace targets (Espeholt et al. 2018, arXiv:1802.01561, section 4.1, remark 2).

        rho_t   = min(rho_clip, ratio_t),   c_t = lam * min(trace_clip, ratio_t)
        delta_t = rho_t * (r_t + discount_t * V(s_{t+1}) - V(s_t))
        v_t     = V(s_t) + delta_t + discount_t * c_t * (v_{t+1} - V(s_{t+1}))
        A_t     = r_t + discount_t * v_{t+1} - V(s_t)

    Here discount_t = discount * (1 - terminated_t), and v_{t+1} - V(s_{t+1}) is 0 behind a step
    that ended an episode and behind the last one. The policy gradient takes rho_t * A_t; they
    are given apart, because a mean that is subtracted from A must be weighted too. With all
    ratios 1 and lam 1 this is `n_step_returns`.

    All arrays are [T, N]. `values` are V(s_t) of the policy that learns, `next_values` V(s_{t+1})
    before any auto-reset, `ratios` the probability of the action under the policy that learns
    over that under the one that acted. `rho_clip` decides which policy's values v approaches,
    `trace_clip` limits variance.
    """
    rho = jnp.minimum(rho_clip, ratios)
    discounts = discount * (1.0 - terminated)
    deltas = rho * (rewards + discounts * next_values - values)
    goes_on = 1.0 - jnp.maximum(terminated, truncated)
    decay = discounts * goes_on * lam * jnp.minimum(trace_clip, ratios)

    def back(later: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, factor = step
        correction = delta + factor * later
        return correction, correction

    zero = jnp.zeros_like(deltas[0])
    corrections = jax.lax.scan(back, zero, (deltas, decay), reverse=True)[1]
    # v_{t+1} - V(s_{t+1}) of the same episode.
    later = goes_on * jnp.concatenate([corrections[1:], zero[None]])
    advantage = rewards + discounts * (next_values + later) - values
    return Returns(value=values + corrections, advantage=advantage, rho=rho)
