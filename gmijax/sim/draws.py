"""Random numbers for tasks: by a JAX key or by a `numpy.random.Generator`.

A generator has a state, so what is split from it is itself. Imports jax for keys only.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gmijax.types import Array, PRNGKey

_Bound = Any  # A float or an array.


def split(key: PRNGKey, num: int = 2) -> Any:
    """So many keys [num] that are independent; consumes `key`."""
    if isinstance(key, np.random.Generator):
        return (key,) * num
    import jax

    return jax.random.split(key, num)


def uniform(
    key: PRNGKey, shape: tuple[int, ...] = (), *, minval: _Bound = 0.0, maxval: _Bound = 1.0
) -> Array:
    """Numbers of `shape`, float32, from `minval` on and below `maxval`."""
    if isinstance(key, np.random.Generator):
        numbers: Any = np.asarray(key.uniform(minval, maxval, shape), np.float32)
        return numbers
    import jax

    return jax.random.uniform(key, shape, minval=minval, maxval=maxval)


def next_key(moves_on: Array, fresh: PRNGKey, key: PRNGKey) -> PRNGKey:
    """`fresh` if the environment `moves_on` [] bool, else `key`; a generator is both."""
    if isinstance(key, np.random.Generator):
        return key
    import jax.numpy as jnp

    return jnp.where(moves_on, fresh, key)
