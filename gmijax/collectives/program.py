"""Exchanges between ranks from within a compiled program.

A program calls by name a Python function of this process (see `xla_call`), which moves the
numbers: at once on a CPU, on a GPU by adding work to the program's stream. So no rank stops
between a gradient and its mean, and a program is the same on all ranks: they share one entry of
the compilation cache.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from gmijax.collectives.host_transport import HostTransport
from gmijax.collectives.interface import Step
from gmijax.collectives.strategies import ReductionStage, values_after
from gmijax.collectives.xla_call import Buffer, register
from gmijax.compile_once import compile_once
from gmijax.devices import host_sharding
from gmijax.errors import CollectiveError

T = TypeVar("T")

_serial = itertools.count()


class StagedAllReduce:
    """One rank's all-reduces in programs, by a strategy's stages."""

    def __init__(
        self,
        transport: HostTransport,
        stages: Sequence[ReductionStage],
        rank: int,
        world_size: int,
    ) -> None:
        self.rank, self.world_size = rank, world_size
        self._transport: HostTransport | None = transport
        self._stages = stages
        # The same on all ranks, which make as many: it is part of their programs.
        self._name = f"gmijax_exchange_{next(_serial)}"
        register(self._name, self._call)

    def sum(self, buffer: jax.Array, call_index: int, after: jax.Array | None = None) -> jax.Array:
        """The sum over ranks of `buffer` [n] float32; `call_index` counts those of a program."""
        total = buffer
        for number, stage in enumerate(self._stages):
            if stage.kind == "all_gather":
                # The largest group's size: the program must be the same on all ranks.
                most = max(len(group) for group in stage.groups)
                rows = self._traced(total, (most, buffer.size), number, call_index, after)
                # Written out, so that it is one pass in the order of ranks, the same on all.
                total = functools.reduce(jnp.add, list(rows))
            else:
                total = self._traced(total, buffer.shape, number, call_index, after)
        return total

    def is_right(self) -> bool:
        """Whether the first two exchanges of these ranks, of known numbers, give what they should.

        All of the ranks call it at the same time.
        """
        assert self._transport is not None

        def two_sums(values: jax.Array) -> tuple[jax.Array, jax.Array]:
            first = self.sum(values, 1)
            return first, self.sum(values + 1.0, 2, after=first)

        sums = jax.jit(two_sums)(jnp.full(self._transport.capacity, self.rank, jnp.float32))
        # Both are read: an error of the device comes with what is read last.
        arrays = [np.asarray(array) for array in sums]
        # Small integers are exact in any order.
        return all(
            np.all(array == values_after(self._stages, range(k, k + self.world_size))[self.rank])
            for k, array in enumerate(arrays)
        )

    def program(self, step: Step, *, donates_own: bool = True) -> ProgramStep:
        """See `Communicator`."""
        assert self._transport is not None
        return ProgramStep(self, self._transport, step, donates_own=donates_own)

    def close(self) -> None:
        """Releases the transport. Idempotent."""
        if self._transport is not None:
            self._transport.close()
        self._transport = None  # XLA keeps the call forever, and with it this object.

    def _traced(
        self,
        values: jax.Array,
        shape: tuple[int, ...],
        stage: int,
        call_index: int,
        after: jax.Array | None,
    ) -> jax.Array:
        if self._transport is None:
            raise CollectiveError(f"rank {self.rank}: exchange after close")
        if values.dtype != jnp.float32:
            raise CollectiveError(f"rank {self.rank}: exchanges float32, not {values.dtype}")
        if values.size > (capacity := self._transport.capacity):
            raise CollectiveError(
                f"rank {self.rank}: {values.size} floats exceed the capacity of {capacity}"
            )
        result = jax.ShapeDtypeStruct(shape, jnp.float32)
        call: Any = jax.ffi.ffi_call(self._name, result, has_side_effect=True)
        arguments = (values,) if after is None else (values, after)
        # `_call` gets them in the order of their names.
        return call(*arguments, call_index=np.int64(call_index), stage=np.int64(stage))

    def _call(
        self, stream: int, arguments: list[Buffer], results: list[Buffer], attributes: list[int]
    ) -> None:
        if self._transport is None:
            raise RuntimeError("the exchange is closed")
        (values, *_), (result,), (call_index, stage) = arguments, results, attributes
        where = (stream, call_index, values.address, result.address, values.shape[0])
        self._transport.reduce(self._stages[stage], *where)


class TracedCollectives:
    """The ranks of an exchange as a program sees them: `Collectives`.

    `rank` [] int32 is an argument of the program, so that all ranks have the same one.
    """

    def __init__(self, all_reduce: StagedAllReduce, rank: jax.Array) -> None:
        self._all_reduce = all_reduce
        self._rank = rank
        self._places = itertools.count(1)

    def rank(self) -> jax.Array:
        """See `Collectives`."""
        return self._rank

    def all_gather(self, tree: T, after: Any = None) -> T:
        """See `Collectives`."""
        packed, unpack = ravel_pytree(tree)  # One message, not one for each leaf.
        # A sum of which each rank gives one row is exact in any order.
        is_own = jnp.arange(self._all_reduce.world_size)[:, None] == self._rank
        rows = self._sum(jnp.where(is_own, packed, 0.0).ravel(), after)
        return jax.vmap(unpack)(rows.reshape(-1, packed.size))

    def mean(self, tree: T, after: Any = None) -> T:
        """See `Collectives`."""
        packed, unpack = ravel_pytree(tree)
        return unpack(self._sum(packed, after) * np.float32(1.0 / self._all_reduce.world_size))

    def _sum(self, buffer: jax.Array, after: Any) -> jax.Array:
        # What has to come before is an argument that is not looked at; one leaf of it does.
        before = next(iter(jax.tree.leaves(after)), None)
        return self._all_reduce.sum(buffer, next(self._places), before)


class LocalCollectives:
    """`Collectives` of a job with one trainer."""

    def rank(self) -> jax.Array:
        """See `Collectives`."""
        return jnp.zeros((), jnp.int32)

    def all_gather(self, tree: T, after: Any = None) -> T:
        """See `Collectives`."""
        del after
        return jax.tree.map(lambda leaf: leaf[None], tree)

    def mean(self, tree: T, after: Any = None) -> T:
        """See `Collectives`."""
        del after
        return tree


class ProgramStep:
    """A step as one program of each rank: `TracedStep`.

    A call returns when the device has been given all of it, and the call before is computed.
    In a job with one rank there are no `all_reduce` and no `transport`.
    """

    def __init__(
        self,
        all_reduce: StagedAllReduce | None,
        transport: HostTransport | None,
        step: Step,
        *,
        donates_own: bool = True,
    ) -> None:
        self._all_reduce, self._transport = all_reduce, transport
        self._donated = (2, 3) if donates_own else (2,)
        self._step = step
        # Put there, not computed: that would be a program of its own.
        self._rank = jax.device_put(np.int32(0 if all_reduce is None else all_reduce.rank))
        self._program: Any = None
        self._constants: Any = None
        self._last: Any = None
        self._metrics: Any = None
        self.exchange_s: float | None = None

    def trace(self, constants: Any, shared: Any, own: Any) -> None:
        """See `TracedStep`."""

        def whole(rank: jax.Array, constants: Any, shared: Any, own: Any) -> tuple[Any, Any, Any]:
            several = self._all_reduce
            ranks = LocalCollectives() if several is None else TracedCollectives(several, rank)
            return self._step(ranks, constants, shared, own)

        # Metrics lie where the host reads them at once: a copy from the device could only be made
        # after the next step, which has been started by then.
        host = host_sharding()
        out_shardings = None if host is None else (None, None, host)
        program = jax.jit(whole, donate_argnums=self._donated, out_shardings=out_shardings)
        self._constants = constants
        self._program = program.lower(self._rank, constants, shared, own)

    def compile(self) -> None:
        """See `TracedStep`."""
        self._program = compile_once(self._program)

    def __call__(self, shared: Any, own: Any) -> tuple[Any, Any, Any]:
        """See `TracedStep`."""
        return self._run(lambda: self._start(shared, own), is_last=False)

    def wait(self) -> None:
        """See `TracedStep`."""
        self._run(lambda: jax.block_until_ready(self._last), is_last=True)

    def _start(self, shared: Any, own: Any) -> tuple[Any, Any, Any]:
        self._last = None  # Donated.
        self._last = self._program(self._rank, self._constants, shared, own)
        if self._metrics is not None:
            jax.block_until_ready(self._metrics)
            if self._transport is not None:
                self.exchange_s = self._transport.exchange_s()
        self._metrics = self._last[2]
        return self._last

    def _run(self, program: Callable[[], T], *, is_last: bool) -> T:
        transport = self._transport
        return program() if transport is None else transport.run(program, is_last=is_last)
