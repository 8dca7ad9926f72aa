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

from gmijax.collectives.host.host_links import HostLinks
from gmijax.collectives.interface import Step
from gmijax.collectives.strategies import Stage
from gmijax.collectives.xla_call import Buffer, register
from gmijax.compile_once import compile_once
from gmijax.devices import host_sharding
from gmijax.errors import CollectiveError

T = TypeVar("T")

_serial = itertools.count()


class Exchange:
    """One rank's exchanges in programs, by a strategy's stages."""

    def __init__(
        self, links: HostLinks, stages: Sequence[Stage], rank: int, world_size: int
    ) -> None:
        self.rank, self.world_size = rank, world_size
        self._links: HostLinks | None = links
        self._stages = stages
        # The same on all ranks, which make as many: it is part of their programs.
        self._name = f"gmijax_exchange_{next(_serial)}"
        register(self._name, self._call)

    def sum(self, buffer: jax.Array, place: int, after: jax.Array | None = None) -> jax.Array:
        """The sum over ranks of `buffer` [n] float32; in a program, where it is number `place`."""
        total = buffer
        for number, stage in enumerate(self._stages):
            if stage.kind == "gather":
                # The largest group's size: the program must be the same on all ranks.
                most = max(len(group) for group in stage.groups)
                rows = self._traced(total, (most, buffer.size), number, place, after)
                # Written out, so that it is one pass in the order of ranks, the same on all.
                total = functools.reduce(jnp.add, list(rows))
            else:
                total = self._traced(total, buffer.shape, number, place, after)
        return total

    def program(self, step: Step, *, donates_own: bool = True) -> ProgramStep:
        """See `Reducer`."""
        assert self._links is not None
        return ProgramStep(self, self._links, step, donates_own=donates_own)

    def close(self) -> None:
        """Releases the links. Idempotent."""
        if self._links is not None:
            self._links.close()
        self._links = None  # XLA keeps the call forever, and with it this object.

    def _traced(
        self,
        values: jax.Array,
        shape: tuple[int, ...],
        number: int,
        place: int,
        after: jax.Array | None,
    ) -> jax.Array:
        if self._links is None:
            raise CollectiveError(f"rank {self.rank}: exchange after close")
        if values.dtype != jnp.float32:
            raise CollectiveError(f"rank {self.rank}: exchanges float32, not {values.dtype}")
        if values.size > (room := self._links.room):
            raise CollectiveError(f"rank {self.rank}: {values.size} floats, room is for {room}")
        result = jax.ShapeDtypeStruct(shape, jnp.float32)
        call: Any = jax.ffi.ffi_call(self._name, result, has_side_effect=True)
        arguments = (values,) if after is None else (values, after)
        return call(*arguments, number=np.int64(number), place=np.int64(place))

    def _call(
        self, stream: int, arguments: list[Buffer], results: list[Buffer], attributes: list[int]
    ) -> None:
        if self._links is None:
            raise RuntimeError("the exchange is closed")
        (values, *_), (result,), (number, place) = arguments, results, attributes
        where = (stream, place, values.address, result.address, values.shape[0])
        self._links.reduce(self._stages[number], *where)


class ProgramPeers:
    """The ranks of an exchange as a program sees them: `Peers`.

    `rank` [] int32 is an argument of the program, so that all ranks have the same one.
    """

    def __init__(self, exchange: Exchange, rank: jax.Array) -> None:
        self._exchange = exchange
        self._rank = rank
        self._places = itertools.count(1)

    def rank(self) -> jax.Array:
        """See `Peers`."""
        return self._rank

    def gather(self, tree: T, after: Any = None) -> T:
        """See `Peers`."""
        packed, unpack = ravel_pytree(tree)  # One message, not one for each leaf.
        # A sum of which each rank gives one row is exact in any order.
        is_own = jnp.arange(self._exchange.world_size)[:, None] == self._rank
        rows = self._sum(jnp.where(is_own, packed, 0.0).ravel(), after)
        return jax.vmap(unpack)(rows.reshape(-1, packed.size))

    def mean(self, tree: T, after: Any = None) -> T:
        """See `Peers`."""
        packed, unpack = ravel_pytree(tree)
        return unpack(self._sum(packed, after) * np.float32(1.0 / self._exchange.world_size))

    def _sum(self, buffer: jax.Array, after: Any) -> jax.Array:
        # What has to come before is an argument that is not looked at; one leaf of it does.
        before = next(iter(jax.tree.leaves(after)), None)
        return self._exchange.sum(buffer, next(self._places), before)


class PeersOfOne:
    """`Peers` of a job with one trainer."""

    def rank(self) -> jax.Array:
        """See `Peers`."""
        return jnp.zeros((), jnp.int32)

    def gather(self, tree: T, after: Any = None) -> T:
        """See `Peers`."""
        del after
        return jax.tree.map(lambda leaf: leaf[None], tree)

    def mean(self, tree: T, after: Any = None) -> T:
        """See `Peers`."""
        del after
        return tree


class ProgramStep:
    """A step as one program of each rank: `TracedStep`.

    A call returns when the device has been given all of it, and the call before is computed.
    In a job with one rank there are no `exchange` and no `links`.
    """

    def __init__(
        self,
        exchange: Exchange | None,
        links: HostLinks | None,
        step: Step,
        *,
        donates_own: bool = True,
    ) -> None:
        self._exchange, self._links = exchange, links
        self._donated = (2, 3) if donates_own else (2,)
        self._step = step
        self._rank = jnp.asarray(0 if exchange is None else exchange.rank, jnp.int32)
        self._program: Any = None
        self._constants: Any = None
        self._last: Any = None
        self._metrics: Any = None
        self.exchange_s: float | None = None

    def trace(self, constants: Any, shared: Any, own: Any) -> None:
        """See `TracedStep`."""

        def whole(rank: jax.Array, constants: Any, shared: Any, own: Any) -> tuple[Any, Any, Any]:
            peers = PeersOfOne() if self._exchange is None else ProgramPeers(self._exchange, rank)
            return self._step(peers, constants, shared, own)

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
            if self._links is not None:
                self.exchange_s = self._links.exchange_s()
        self._metrics = self._last[2]
        return self._last

    def _run(self, program: Callable[[], T], *, is_last: bool) -> T:
        return program() if self._links is None else self._links.run(program, is_last=is_last)
