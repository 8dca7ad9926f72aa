"""Parts of the loss that PPO and A3C share."""

from __future__ import annotations

import jax.numpy as jnp

from gmijax.types import Array

_ACTION_BOUND = 1.1
"""Means beyond this are penalised; actions are clipped to 1, and a little room is harmless."""


def clipped_surrogate(ratio: Array, advantage: Array, epsilon: float) -> Array:
    """Gain [...] of every sample, to be maximised (PPO, arXiv:1707.06347, equation 7).

    A change of the policy gains nothing beyond a probability ratio of 1 +- `epsilon`.
    """
    clipped = jnp.clip(ratio, 1.0 - epsilon, 1.0 + epsilon)
    return jnp.minimum(ratio * advantage, clipped * advantage)


def bound_loss(mean: Array) -> Array:
    """Squared distance [...] of action means [..., A] from [-1.1, 1.1]."""
    return jnp.sum(jnp.maximum(jnp.abs(mean) - _ACTION_BOUND, 0.0) ** 2, -1)
