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
        # A jit within: otherwise constants of the step become arguments of the program's parts.
        self._step = jax.jit(functools.partial(step, MeshPeers(ranks)))
        self._program: Any = None
        self._constants: Any = None
        self._shapes: Any = (None, None)
        self._returned: Any = (None, None)
        self._next: Any = None

    def trace(self, constants: Any, shared: Any, own: Any) -> None:
        """See `TracedStep`."""
        constant_shapes, own_shapes = jax.eval_shape(lambda *trees: trees, constants, own)

        def inside(constants: Any, shared: Any, own: Any) -> tuple[Any, Any, Any]:
            constants = _with_empty(constant_shapes, constants)
            shared, own, told = self._step(constants, shared, _with_empty(own_shapes, own))
            self._shapes = own_shapes, jax.eval_shape(lambda tree: tree, told)
            return shared, _without_empty(own), _packed(told)

        # That members get the same `shared` is for the step to see to: of an `all_gather` jax
        # does not know it.
        constants, own_specs = _without_empty(constants), _parts(_without_empty(own))
        mapped = jax.shard_map(
            inside,
            mesh=self._mesh,
            in_specs=(_parts(constants), _EQUAL, own_specs),
            out_specs=(_EQUAL, own_specs, _EQUAL),
            check_vma=False,
        )
        self._constants = self._whole(constants, _parts(constants))
        self._program = jax.jit(mapped, donate_argnums=(1, 2)).lower(
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
        results = self._program(self._constants, *wholes)
        # While the devices are busy: two hundred views take the host milliseconds.
        self._next = results[:2]
        shared, own, packed = jax.tree.map(lambda whole: whole.addressable_data(0), results)
        own_shapes, told_shapes = self._shapes
        self._returned = shared, _with_empty(own_shapes, own)
        # Not left on the device until somebody reads it: where steps find memory would then
        # depend on when that is, and MJX-Warp records its work anew for other addresses.
        return *self._returned, _unpacked(told_shapes, packed)

    def _wholes(self, shared: Any, own: Any) -> tuple[Any, Any]:
        own = _without_empty(own)
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


def _without_empty(tree: Any) -> Any:
    """None for arrays with no elements, of which models of MuJoCo have many.

    XLA's compiler for GPUs crashes where they are arguments of a part of a program (jax 0.11.2).
    """
    return jax.tree.map(lambda leaf: leaf if jnp.size(leaf) else None, tree)


def _with_empty(shapes: Any, tree: Any) -> Any:
    """The inverse, given a tree of the same shapes."""

    def leaf_or_empty(shape: Any, leaf: Any) -> Any:
        return jnp.zeros(jnp.shape(shape), shape.dtype) if leaf is None else leaf

    return jax.tree.map(leaf_or_empty, shapes, tree)


def _packed(tree: Any) -> jax.Array | None:
    """[M] float32, all numbers of `tree` in one message; None where there are none."""
    leaves = jax.tree.leaves(tree)
    return jnp.concatenate([jnp.ravel(x).astype(jnp.float32) for x in leaves]) if leaves else None


def _unpacked(shapes: Any, packed: jax.Array | None) -> Any:
    """The inverse, in host memory; waits for `packed`."""
    if packed is None:
        return shapes
    leaves, structure = jax.tree.flatten(shapes)
    ends = np.cumsum([leaf.size for leaf in leaves])
    parts = np.split(np.asarray(packed), ends[:-1])
    arrays = (p.reshape(x.shape).astype(x.dtype) for p, x in zip(parts, leaves, strict=True))
    return jax.tree.unflatten(structure, arrays)
