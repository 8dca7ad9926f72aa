"""Arrays of numpy, torch or jax, as the caller of a vector environment has them.

What is handed out is the caller's own: it may be written into, and no later step changes it.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.types import Array, PyTree

Arrays: TypeAlias = Literal["numpy", "torch", "jax"]


def hand_out(tree: PyTree, arrays: Arrays) -> Any:
    """Results of a compiled program as the caller's arrays.

    Torch takes over jax's memory, because a program gives each of its results a buffer of its
    own. Numpy would see that memory read-only, so it gets a copy.
    """
    if arrays == "jax":
        return tree
    return jax.tree.map(_to_torch if arrays == "torch" else np.array, tree)


def take_in(given: Any) -> Array:
    """Numbers of any kind of array as float32 of jax; never the caller's own memory.

    A task may keep an action in its state, where later writes of the caller must not show.
    """
    if isinstance(given, jax.Array):
        return given.astype(jnp.float32)
    if hasattr(given, "detach"):
        given = given.detach().float().contiguous()
        if given.device.type != "cpu":
            # Copied by torch, in the order of its own work; jax refuses to copy here.
            return jnp.from_dlpack(given.clone())
        given = given.numpy()
    return jnp.array(np.asarray(given, np.float32), copy=True)


def _to_torch(array: Array) -> Any:
    import torch  # pyright: ignore[reportMissingImports]

    is_on_cpu = all(device.platform == "cpu" for device in array.devices())
    if not is_on_cpu and not torch.cuda.is_available():
        return torch.from_numpy(np.array(array))
    return torch.from_dlpack(array)
