"""One program on the devices of several GMIs, each with arrays of its own: plain data parallelism.

What a GMI carries from step to step stays on its device. For jax each array is a part of one that
lies on all devices, or the same on all of them; neither view costs a copy.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from gmijax.collectives.interface import Step

AXIS = "ring"
_EQUAL = PartitionSpec()
_PART = PartitionSpec(AXIS)


class MeshPeers:
    """The members of a mesh as a program sees them that runs on all: `Peers`.

    Args:
      ranks: of the members, in the order of the mesh.
    """

    def __init__(self, ranks: Sequence[int]) -> None:
        self._ranks = np.array(ranks, np.int32)

    def rank(self) -> jax.Array:
        """See `Peers`."""
        return jnp.asarray(self._ranks)[jax.lax.axis_index(AXIS)]

    def gather(self, values: jax.Array) -> jax.Array:
        """See `Peers`."""
        return jax.lax.all_gather(values, AXIS)

    def mean(self, buffer: jax.Array) -> jax.Array:
        """See `Peers`."""
        return jax.lax.psum(buffer, AXIS) * np.float32(1.0 / len(self._ranks))


class JointStep:
    """A step of several GMIs as one program: `TracedStep`.

    Every member calls it, and is then caught in it until all others have: meet them before.

    Args:
      mesh: one device of each member, along `AXIS`.
      ranks: of the members, in the same order.
      step: see `Step`.
    """

    def __init__(self, mesh: Mesh, ranks: Sequence[int], step: Step) -> None:
        self._mesh = mesh
        self._step = functools.partial(step, MeshPeers(ranks))
        self._program: Any = None
        self._constants: Any = None
        self._returned: Any = (None, None)
        self._next: Any = None

    def trace(self, constants: Any, shared: Any, own: Any) -> None:
        """See `TracedStep`."""
        constants_specs, own_specs = _parts(constants), _parts(own)
        # That members get the same `shared` is for the step to see to: of an `all_gather` jax
        # does not know it.
        inside = jax.shard_map(
            self._step,
            mesh=self._mesh,
            in_specs=(constants_specs, _EQUAL, own_specs),
            out_specs=(_EQUAL, own_specs, _EQUAL),
            check_vma=False,
        )
        self._constants = self._whole(constants, constants_specs)
        self._program = jax.jit(inside, donate_argnums=(1, 2)).lower(
            self._constants, *self._wholes(shared, own)
        )

    def compile(self) -> None:
        """See `TracedStep`."""
        on_gpu = self._mesh.local_devices[0].platform == "gpu"
        # Members have left jax's coordination service, by which they would share the tuning.
        self._program = self._program.compile(
            {"xla_gpu_shard_autotuning": False} if on_gpu else {}
        )

    def __call__(self, shared: Any, own: Any) -> tuple[Any, Any, Any]:
        """See `TracedStep`."""
        is_next = shared is self._returned[0] and own is self._returned[1]
        wholes = self._next if is_next else self._wholes(shared, own)
        self._next = None  # Donated.
        shared, own, told = self._program(self._constants, *wholes)
        # While the devices are busy: two hundred views take the host milliseconds.
        self._next = (shared, own)
        mine = jax.tree.map(lambda whole: whole.addressable_data(0), (shared, own, told))
        self._returned = mine[:2]
        for leaf in jax.tree.leaves(mine[2]):
            leaf.copy_to_host_async()
        return mine

    def _wholes(self, shared: Any, own: Any) -> tuple[Any, Any]:
        equal = jax.tree.map(lambda _: _EQUAL, shared)
        return self._whole(shared, equal), self._whole(own, _parts(own))

    def _whole(self, tree: Any, specs: Any) -> Any:
        """This member's arrays as jax sees those of all together."""

        def whole(array: Any, spec: PartitionSpec) -> jax.Array:
            array = jnp.asarray(array)
            shape = array.shape
            if spec == _PART:
                shape = (shape[0] * self._mesh.size, *shape[1:])
            sharding = NamedSharding(self._mesh, spec)
            return jax.make_array_from_single_device_arrays(shape, sharding, [array])

        return jax.tree.map(whole, tree, specs)


def _parts(tree: Any) -> Any:
    """How each array of a member's own lies among all: a number has no axis to be a part along."""
    return jax.tree.map(lambda leaf: _PART if jnp.ndim(leaf) else _EQUAL, tree)
