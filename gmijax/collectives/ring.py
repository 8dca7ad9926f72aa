"""Rings between GPUs: the only owner of `jax.distributed`, and of what jax keeps private about it.

All GMIs of a job become processes of one jax world, which gives programs over the devices of
several GMIs: NCCL between GPUs, gloo between processes on the CPU. `docs/reduction.md` says why
the world is left again as soon as it stands.
"""

from __future__ import annotations

import atexit
import functools
import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import jaxlib._jax as _jax
import numpy as np

# Private: jax offers no other way to choose gloo's address, or who writes compiled programs.
from jax._src import distributed, xla_bridge
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from gmijax.collectives.courier import end_at_once
from gmijax.collectives.spmd import AXIS
from gmijax.collectives.sums import ordered_sum
from gmijax.errors import CollectiveError
from gmijax.partition.layout import Layout

_LOCAL_HOST = "127.0.0.1"
_LEAVE_TIMEOUT_S = 300

_Program: TypeAlias = Callable[[float, jax.Array], jax.Array]
"""What a member does with a number, the same on all, and its buffer."""


class World:
    """This process among those of all GMIs.

    Args:
      layout: where all GMIs live.
      rank: this one.

    Attributes:
      layout: the same.
      rank: the same.
      is_kept: more rings are to come, and who joined leaves by itself when they stand.
    """

    def __init__(self, layout: Layout, rank: int) -> None:
        self.is_kept = False
        self.layout = layout
        self.rank = rank
        self._process_ids = process_ids(layout)

    @classmethod
    def join(cls, layout: Layout, rank: int, address: str, timeout_s: float) -> World:
        """Meets the other GMIs; call it before anything else uses jax.

        Args:
          layout: where all GMIs live.
          rank: this one.
          address: `127.0.0.1:port`, the same for all; one of them listens there for a while.
          timeout_s: longest wait for the others.

        Raises:
          CollectiveError: they cannot be met.
        """
        world = cls(layout, rank)
        # Who fails before it has left must not wait for the others when it ends.
        atexit.register(end_at_once)
        # Its handler would keep SIGTERM from ending a GMI.
        jax.config.update("jax_enable_preemption_service", False)
        try:
            jax.distributed.initialize(
                coordinator_address=address,
                num_processes=layout.num_gmis,
                process_id=world._process_ids[rank],
                local_device_ids=[0],
                initialization_timeout=math.ceil(timeout_s),
                coordinator_bind_address=address,
                shutdown_timeout_seconds=_LEAVE_TIMEOUT_S,
            )
        except (RuntimeError, ValueError) as error:
            lines = str(error).strip().splitlines() or [type(error).__name__]
            raise CollectiveError(
                f"rank {rank}: cannot meet the other GMIs at {address}: {lines[0]}"
            ) from error
        xla_bridge.register_backend_factory("cpu", _cpu_client, priority=0, fail_quietly=False)
        # Devices are exchanged when jax makes its client, and that waits for all processes.
        jax.devices()
        return world

    def mesh(self, ranks: Sequence[int]) -> Mesh:
        """A device of each of the GMIs `ranks`, along `AXIS`."""
        by_process = {device.process_index: device for device in jax.devices()}
        return Mesh(np.array([by_process[self._process_ids[rank]] for rank in ranks]), (AXIS,))

    def ring(self, ranks: Sequence[int], num_floats: int) -> Ring:
        """A ring of the GMIs `ranks`, of which this one must be one; no communication yet."""
        return Ring(self.mesh(ranks), num_floats)

    def leave(self) -> None:
        """Leaves the coordination service, when all rings have been used once.

        A connection to it would end this process when another one dies, before it could say
        which. All GMIs must call it; rings that have been used go on working.
        """
        jax.distributed.shutdown()
        atexit.unregister(end_at_once)
        # Only process 0 writes to the compilation cache. On the CPU a program belongs to one
        # device of the world, so the others would compile theirs anew in every job; on GPUs the
        # GMI that compiles for all need not be process 0.
        distributed.global_state.process_id = 0


class Ring:
    """A sum over the devices of some GMIs, as one compiled program.

    Args:
      mesh: a device of each GMI, each on another GPU.
      num_floats: P, length of the buffers.
    """

    def __init__(self, mesh: Mesh, num_floats: int) -> None:
        self._mesh = mesh
        self._sharding = NamedSharding(mesh, PartitionSpec(AXIS))
        self._global_shape = (mesh.size * num_floats,)
        self._programs: dict[tuple[_Program, float], Callable[[jax.Array], jax.Array]] = {}

    def sum(self, buffer: jax.Array, scale: float = 1.0) -> jax.Array:
        """The sum over the ring of `buffer` [P] float32, times `scale`; on this GMI's device."""
        return self._run(_sum, scale, buffer)

    def ordered_sum(self, buffer: jax.Array, scale: float) -> jax.Array:
        """As `sum`, but summed by places: other rings with the same buffers get the same bits."""
        return self._run(_ordered_sum, scale, buffer)

    def broadcast(self, buffer: jax.Array, source: int) -> jax.Array:
        """The `buffer` [P] of the member at place `source`, on the device of every member."""
        return self._run(_broadcast, source, buffer)

    def _run(self, program: _Program, number: float, buffer: jax.Array) -> jax.Array:
        if (program, number) not in self._programs:
            self._programs[program, number] = self._compiled(functools.partial(program, number))
        whole = jax.make_array_from_single_device_arrays(
            self._global_shape, self._sharding, [buffer]
        )
        return self._programs[program, number](whole).addressable_data(0)

    def _compiled(
        self, program: Callable[[jax.Array], jax.Array]
    ) -> Callable[[jax.Array], jax.Array]:
        # That all members get the same is for the programs to see to: of an `all_gather` jax
        # does not know it.
        inside = jax.shard_map(
            program,
            mesh=self._mesh,
            in_specs=PartitionSpec(AXIS),
            out_specs=PartitionSpec(),
            check_vma=False,
        )
        return jax.jit(inside)


def _sum(scale: float, buffer: jax.Array) -> jax.Array:
    return jax.lax.psum(buffer, AXIS) * np.float32(scale)


def _broadcast(source: float, buffer: jax.Array) -> jax.Array:
    # The others add zeros, which changes no value.
    mine = jnp.where(jax.lax.axis_index(AXIS) == int(source), buffer, 0.0)
    return jax.lax.psum(mine, AXIS)


def _ordered_sum(scale: float, buffer: jax.Array) -> jax.Array:
    return ordered_sum(jax.lax.all_gather(buffer, AXIS), scale)


def process_ids(layout: Layout) -> tuple[int, ...]:
    """The number of every rank's process in the world, ring by ring.

    Members of a ring, the k-th GMI of every GPU, get consecutive numbers: XLA complains about
    rings that skip some.
    """
    most = max(len(gmis) for gmis in layout.gmis_of_gpu)
    in_order = [
        gmis[place] for place in range(most) for gmis in layout.gmis_of_gpu if place < len(gmis)
    ]
    return tuple(in_order.index(gmi) for gmi in layout.gmis)


def _cpu_client() -> object:
    # By itself gloo would listen at the address of the host's name, which others may reach.
    collectives = _jax.make_gloo_tcp_collectives(
        distributed_client=distributed.global_state.client, hostname=_LOCAL_HOST
    )
    return xla_bridge.make_cpu_client(collectives)
