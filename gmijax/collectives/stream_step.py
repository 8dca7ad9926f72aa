"""A step of several GMIs, each its own program, with exchanges on the streams of their devices.

For GMIs that share GPUs what `spmd` is for those that have one each: a step goes to the device as
a whole, and the host does not come between gradient and mean.
"""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp

from gmijax.collectives.interface import Step
from gmijax.collectives.stream_exchange import StreamExchange
from gmijax.collectives.sums import ordered_sum
from gmijax.devices import host_sharding


class StreamPeers:
    """The ranks of an exchange as a program sees them: `Peers`.

    Args:
      exchange: this rank's part.
      rank: [] int32, an argument of the program, so that all ranks have the same one.
    """

    def __init__(self, exchange: StreamExchange, rank: jax.Array) -> None:
        self._exchange = exchange
        self._rank = rank
        self._places = itertools.count()

    def rank(self) -> jax.Array:
        """See `Peers`."""
        return self._rank

    def gather(self, values: jax.Array) -> jax.Array:
        """See `Peers`; float32."""
        return self._gather(values, "gather")

    def mean(self, buffer: jax.Array) -> jax.Array:
        """See `Peers`."""
        return ordered_sum(self._gather(buffer, "mean"), 1.0 / self._exchange.world_size)

    def _gather(self, values: jax.Array, kind: str) -> jax.Array:
        kind = f"number {next(self._places)} of the trace, {kind} of {list(values.shape)} floats"
        gathered = self._exchange.gather(values.ravel(), kind)
        return gathered.reshape(-1, *values.shape)


class StreamStep:
    """A step of several GMIs as one program of each: `TracedStep`.

    Every rank calls it, and its device then waits in it for the others': meet them before. A
    call returns when the device has been given all of it, and the call before is computed.

    Args:
      exchange: this rank's part.
      step: see `Step`.

    Attributes:
      exchange_s: see `TracedStep`.
    """

    def __init__(self, exchange: StreamExchange, step: Step) -> None:
        self._exchange = exchange
        self._step = step
        self._rank = jnp.asarray(exchange.rank, jnp.int32)
        self._program: Any = None
        self._constants: Any = None
        self._last: Any = None
        self._told: Any = None
        self.exchange_s: float | None = None

    def trace(self, constants: Any, shared: Any, own: Any) -> None:
        """See `TracedStep`."""

        def whole(rank: jax.Array, constants: Any, shared: Any, own: Any) -> tuple[Any, Any, Any]:
            return self._step(StreamPeers(self._exchange, rank), constants, shared, own)

        told = host_sharding()  # As metrics of one GMI (`StepOfOne`).
        out_shardings = None if told is None else (None, None, told)
        program = jax.jit(whole, donate_argnums=(2, 3), out_shardings=out_shardings)
        self._constants = constants
        self._program = program.lower(self._rank, constants, shared, own)

    def compile(self) -> None:
        """See `TracedStep`."""
        self._program = self._program.compile()

    def __call__(self, shared: Any, own: Any) -> tuple[Any, Any, Any]:
        """See `TracedStep`."""
        self._last = None  # Donated.
        shared, own, metrics = self._program(self._rank, self._constants, shared, own)
        self._last = shared, own, metrics
        if self._told is not None:
            jax.block_until_ready(self._told)
            self.exchange_s = self._exchange.clocked_s()
        self._told = metrics
        return self._last

    def wait(self) -> None:
        """See `TracedStep`."""
        jax.block_until_ready(self._last)
