"""One program on the devices of several GMIs (SPMD), each with arrays of its own.

That is plain data parallelism. What a GMI carries from step to step stays on its device. For jax
each array is a part of one that lies on all devices, or the same on all of them; neither view
costs a copy.
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
_REPLICATED = PartitionSpec()
_SHARDED = PartitionSpec(AXIS)


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
        in_mesh = jax.lax.all_gather(values, AXIS)
        return jnp.stack([in_mesh[place] for place in np.argsort(self._ranks)])

    def mean(self, buffer: jax.Array) -> jax.Array:
        """See `Peers`."""
        return jax.lax.psum(buffer, AXIS) * np.float32(1.0 / len(self._ranks))


class SpmdStep:
    """A step of several GMIs as one program: `TracedStep`.

    Every member calls it, and its device is then caught in it until all others have: meet them
    before. A call returns when the device has been given all of it, and the call before is
    computed: so it has the next one waiting when it is through with this one.

    Args:
      mesh: one device of each member, along `AXIS`.
      ranks: of the members, in the same order.
      step: see `Step`.

    Attributes:
      exchange_s: see `TracedStep`.
    """

    exchange_s = None

    def __init__(self, mesh: Mesh, ranks: Sequence[int], step: Step) -> None:
        self._mesh = mesh
        # A jit within: otherwise constants of the step become arguments of the program's parts.
        self._step = jax.jit(functools.partial(step, MeshPeers(ranks)))
        self._program: Any = None
        self._constants: Any = None
        self._own_empty: Any = None
        self._returned: Any = (None, None)
        self._next: Any = None
        self._told: Any = None

    def trace(self, constants: Any, shared: Any, own: Any) -> None:
        """See `TracedStep`."""
        whole_constants, whole_own = constants, own

        def inside(constants: Any, shared: Any, own: Any) -> tuple[Any, Any, Any]:
            constants = _merged(constants, _empty(whole_constants))
            own = _merged(own, _empty(whole_own))
            shared, own, metrics = self._step(constants, shared, own)
            return shared, _without_empty(own), metrics

        # That members get the same `shared` is for the step to see to: of an `all_gather` jax
        # does not know it.
        self._own_empty = _empty(own)
        constants, own_specs = _without_empty(constants), _specs(_without_empty(own))
        mapped = jax.shard_map(
            inside,
            mesh=self._mesh,
            in_specs=(_specs(constants), _REPLICATED, own_specs),
            out_specs=(_REPLICATED, own_specs, _REPLICATED),
            check_vma=False,
        )
        self._constants = self._global(constants, _specs(constants))
        # Metrics are in memory of the host, as those of one GMI (`StepOfOne`).
        told = NamedSharding(self._mesh, _REPLICATED, memory_kind="pinned_host")
        out_shardings = (None, None, told) if self._is_on_gpus else None
        program = jax.jit(mapped, donate_argnums=(1, 2), out_shardings=out_shardings)
        self._program = program.lower(self._constants, *self._arguments(shared, own))

    def compile(self) -> None:
        """See `TracedStep`."""
        # Members have left jax's coordination service, by which they would share the tuning.
        self._program = self._program.compile(
            {"xla_gpu_shard_autotuning": False} if self._is_on_gpus else {}
        )

    def __call__(self, shared: Any, own: Any) -> tuple[Any, Any, Any]:
        """See `TracedStep`."""
        is_next = shared is self._returned[0] and own is self._returned[1]
        arguments = self._next if is_next else self._arguments(shared, own)
        self._returned, self._next = (None, None), None  # Donated.
        results = self._program(self._constants, *arguments)
        # While the devices are busy: two hundred views take the host milliseconds.
        self._next = results[:2]
        shared, own, metrics = jax.tree.map(lambda array: array.addressable_data(0), results)
        self._returned = shared, _merged(own, self._own_empty)
        jax.block_until_ready(self._told)
        self._told = metrics
        return *self._returned, metrics

    def wait(self) -> None:
        """See `TracedStep`."""
        jax.block_until_ready((self._next, self._told))

    @property
    def _is_on_gpus(self) -> bool:
        return self._mesh.local_devices[0].platform == "gpu"

    def _arguments(self, shared: Any, own: Any) -> tuple[Any, Any]:
        own = _without_empty(own)
        replicated = jax.tree.map(lambda _: _REPLICATED, shared)
        return self._global(shared, replicated), self._global(own, _specs(own))

    def _global(self, tree: Any, specs: Any) -> Any:
        """This member's arrays as jax sees those of all together."""

        def one(array: Any, spec: PartitionSpec) -> jax.Array:
            array = jnp.asarray(array)
            shape = array.shape
            if spec == _SHARDED:
                shape = (shape[0] * self._mesh.size, *shape[1:])
            sharding = NamedSharding(self._mesh, spec)
            return jax.make_array_from_single_device_arrays(shape, sharding, [array])

        return jax.tree.map(one, tree, specs)


def _specs(tree: Any) -> Any:
    """How the arrays of a member lie among those of all.

    A number has no axis to be sharded along. Each member computes with its own all the same: in
    a `shard_map` nothing is made equal.
    """
    return jax.tree.map(lambda leaf: _SHARDED if jnp.ndim(leaf) else _REPLICATED, tree)


def _without_empty(tree: Any) -> Any:
    """None for arrays with no elements, of which models of MuJoCo have many.

    XLA's compiler for GPUs crashes where they are arguments of a part of a program (jax 0.11.2).
    """
    return jax.tree.map(lambda leaf: leaf if jnp.size(leaf) else None, tree)


def _empty(tree: Any) -> Any:
    """The arrays with no elements, made anew, and None for all others."""
    return jax.tree.map(lambda x: None if jnp.size(x) else jnp.zeros(x.shape, x.dtype), tree)


def _merged(tree: Any, empty: Any) -> Any:
    """The whole, from what `_without_empty` and `_empty` give."""
    return jax.tree.map(
        lambda leaf, other: other if leaf is None else leaf,
        *(tree, empty),
        is_leaf=lambda leaf: leaf is None,
    )
