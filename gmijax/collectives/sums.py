"""Sums of arrays on a device that all ranks compute to the same bits."""

from __future__ import annotations

import functools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np


def ordered_sum(parts: Iterable[jax.Array], scale: float) -> jax.Array:
    """The sum of `parts` [n] float32 in their order, times `scale`; for use within a program."""
    # Written out, so that it is one pass in a fixed order, not a reduction in some order.
    return functools.reduce(jnp.add, list(parts)) * np.float32(scale)
