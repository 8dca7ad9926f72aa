"""Running mean and variance as mergeable statistics.

`Moments` of any split of the samples merge to the moments of all of them (Chan et al. 1979,
"Updating formulae and a pairwise algorithm for computing sample variances"), so several GMIs
can share them: each sends the moments of its own rollout. `with_std_floor` and `std_of` also take
moments in numpy, of which files of policies are written.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gmijax.arrays import array_module
from gmijax.types import Array

OBS_CLIP = 10.0
"""Normalised observations are clipped to [-OBS_CLIP, OBS_CLIP] standard deviations."""

OUTLIER_STD = 20.0
"""Samples farther from the mean than this count as this far in the statistics."""

MIN_STD = 1e-4
"""No standard deviation is smaller: that of constant samples is 0."""


class Moments(NamedTuple):
    """Statistics of samples of shape S.

    Attributes:
      count: [] float32, number of samples.
      mean: S float32.
      m2: S float32, sum of squared differences from the mean.
    """

    count: Array
    mean: Array
    m2: Array


def without_outliers(moments: Moments, samples: Array) -> Array:
    """`samples` [..., S], clipped to OUTLIER_STD around the mean that `moments` know.

    An environment about to diverge shows values thousands of times the usual; a few of them would
    widen the variance for good and blind the policy. Real changes are not held up: the variance
    may grow 400-fold in one merge. Nothing is clipped while there are no statistics.
    """
    bound = jnp.where(moments.count > 0, OUTLIER_STD * std_of(moments), jnp.inf)
    return jnp.clip(samples, moments.mean - bound, moments.mean + bound)


def no_samples(shape: tuple[int, ...]) -> Moments:
    """The neutral element of `merge`."""
    return Moments(jnp.zeros(()), jnp.zeros(shape), jnp.zeros(shape))


def with_std_floor(moments: Moments, floor: float) -> Moments:
    """`moments` with no standard deviation below `floor`; no samples stay none."""
    if floor <= MIN_STD:  # `std_of` sees to that.
        return moments
    xp = array_module(moments.m2)
    return moments._replace(m2=xp.maximum(moments.m2, floor**2 * moments.count))


def moments_of_those(chosen: Array, samples: Array) -> Moments:
    """Moments of the `chosen` [...] bool of `samples` [..., S]."""
    axes = tuple(range(chosen.ndim))
    where = jnp.expand_dims(chosen, range(chosen.ndim, samples.ndim))
    count = jnp.sum(chosen, dtype=jnp.float32)
    mean = jnp.sum(jnp.where(where, samples, 0.0), axes) / jnp.maximum(count, 1.0)
    m2 = jnp.sum(jnp.where(where, (samples - mean) ** 2, 0.0), axes)
    return Moments(count, mean, m2)


def moments_of(samples: Array, num_sample_axes: int) -> Moments:
    """Moments over the first `num_sample_axes` axes of `samples`."""
    axes = tuple(range(num_sample_axes))
    count = float(math.prod(samples.shape[:num_sample_axes]))
    mean = jnp.mean(samples, axis=axes)
    return Moments(jnp.asarray(count), mean, jnp.sum((samples - mean) ** 2, axis=axes))


def merge(a: Moments, b: Moments) -> Moments:
    """Moments of the union of two disjoint sets of samples; associative up to rounding."""
    count = a.count + b.count
    fraction = b.count / jnp.maximum(count, 1.0)
    delta = b.mean - a.mean
    return Moments(
        count=count,
        mean=a.mean + delta * fraction,
        m2=a.m2 + b.m2 + delta**2 * a.count * fraction,
    )


def merge_all(stacked: Moments) -> Moments:
    """Merges moments stacked along a leading axis [K, ...], in order."""
    parts = [jax.tree.map(lambda x, k=k: x[k], stacked) for k in range(stacked.count.shape[0])]
    return reduce(merge, parts)


def std_of(moments: Moments) -> Array:
    """Standard deviation, 1 while there are no samples; never below 1e-4."""
    xp = array_module(moments.m2)
    variance = moments.m2 / xp.maximum(moments.count, 1.0)
    return xp.where(moments.count > 0, xp.maximum(xp.sqrt(variance), MIN_STD), 1.0)


def in_units(moments: Moments, samples: Array) -> Array:
    """`samples` [..., S] in standard deviations from the mean; `from_units` inverts it."""
    return (samples - moments.mean) / std_of(moments)


def from_units(moments: Moments, samples: Array) -> Array:
    """Inverts `in_units`."""
    return moments.mean + std_of(moments) * samples


def change_of_units(old: Moments, new: Moments, least_std: float) -> tuple[Array, Array]:
    """[S] each, `scale` and `shift`, with in_units(old, x) = scale * in_units(new, x) + shift.

    1 and 0 where a unit is not trusted: `old` are no samples, a standard deviation is below
    `least_std`, or it more than doubles or halves.
    """
    before, after = std_of(old), std_of(new)
    scale, shift = after / before, in_units(old, new.mean)
    known = (old.count > 0) & (jnp.minimum(before, after) >= least_std)
    known &= (scale >= 0.5) & (scale <= 2.0)
    return jnp.where(known, scale, 1.0), jnp.where(known, shift, 0.0)


def normalize(moments: Moments, samples: Array) -> Array:
    """`samples` [..., S] in standard deviations from the mean, clipped to +-OBS_CLIP.

    As they are while there are no statistics: their unit is not known, and so no limit.
    """
    limit = jnp.where(moments.count > 0, OBS_CLIP, jnp.inf)
    return jnp.clip(in_units(moments, samples), -limit, limit)
