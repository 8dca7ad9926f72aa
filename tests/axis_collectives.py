"""Trainers as an axis of one program: steps of several trainers without several processes."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import numpy as np

from gmijax.collectives.interface import Step

T = TypeVar("T")
_AXIS = "trainers"


class AxisCollectives:
    """`Collectives` along an axis of `jax.vmap`."""

    def __init__(self, world_size: int) -> None:
        self._world_size = world_size

    def rank(self) -> jax.Array:
        return jax.lax.axis_index(_AXIS).astype("int32")

    def all_gather(self, tree: T, after: Any = None) -> T:
        del after
        return jax.tree.map(lambda leaf: jax.lax.all_gather(leaf, _AXIS), tree)

    def mean(self, tree: T, after: Any = None) -> T:
        del after
        scale = np.float32(1.0 / self._world_size)
        return jax.tree.map(lambda leaf: jax.lax.psum(leaf, _AXIS) * scale, tree)


def run_together(step: Step, constants: Any, shared: Any, own: Any) -> tuple[Any, Any, Any]:
    """What every trainer's step returns, with a leading axis, as `own` has one."""
    world_size = jax.tree.leaves(own)[0].shape[0]

    def one(own: Any) -> tuple[Any, Any, Any]:
        return step(AxisCollectives(world_size), constants, shared, own)

    return jax.jit(jax.vmap(one, axis_name=_AXIS))(own)
