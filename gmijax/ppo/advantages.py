"""Generalised advantage estimation."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from gmijax.types import Array


def gae(
    rewards: Array,
    values: Array,
    next_values: Array,
    terminated: Array,
    truncated: Array,
    *,
    discount: float,
    lam: float,
) -> Array:
    """Advantages [T, N]; all arrays are [T, N] (Schulman et al. 2016, arXiv:1506.02438).

        delta_t = r_t + discount * (1 - terminated_t) * V(s_{t+1}) - V(s_t)
        A_t     = delta_t + discount * lam * (1 - ended_t) * A_{t+1}

    `next_values[t]` is V(s_{t+1}) before any auto-reset: a truncated step bootstraps from it, a
    terminated one does not, and neither lets the next episode's advantages through.
    """
    deltas = rewards + discount * (1.0 - terminated) * next_values - values
    decay = discount * lam * (1.0 - jnp.maximum(terminated, truncated))

    def back(later: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, factor = step
        advantage = delta + factor * later
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(deltas[0]), (deltas, decay), reverse=True)[1]
