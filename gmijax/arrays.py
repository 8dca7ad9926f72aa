"""The same lines of code for numpy and for JAX; imports no jax.

A function that begins with `xp = array_module(x)` runs on whichever of the two its arguments are
of, as the Python array API standard has it. So a task that is trained in JAX is played without.
"""

from __future__ import annotations

from typing import Any

import numpy as np

_OF_NUMPY = (np.ndarray, np.generic, bool, int, float)


def array_module(*values: Any) -> Any:
    """`jax.numpy` if any of the values is an array of JAX, traced ones included, else `numpy`."""
    for value in values:
        if not isinstance(value, _OF_NUMPY):
            return value.__array_namespace__()
    return np


def constant(values: Any) -> Any:
    """Numbers as float32 of numpy, which JAX takes as they are."""
    return np.asarray(values, np.float32)


def replaced(array: Any, where: Any, values: Any) -> Any:
    """A copy of an array with `values` at the indices `where`, or from `where` on if it is an int.

    `array` may be of numpy where `values` are of JAX: so is then what is returned.
    """
    xp = array_module(array, values)
    if xp is np:
        changed = np.array(array)
        changed[slice(where, where + len(values)) if isinstance(where, int) else where] = values
        return changed
    array = xp.asarray(array)
    if isinstance(where, int):
        import jax

        return jax.lax.dynamic_update_slice(array, values, (where,))
    return array.at[where].set(values)
