"""Runs the stages of a reduction through shared memory of the host."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import jax
import numpy as np

from gmijax.collectives.host.host_exchange import HostExchange
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.nodes.node_exchange import NodeExchange
from gmijax.collectives.strategies import Stage
from gmijax.errors import GmijaxError

if TYPE_CHECKING:
    from gmijax.collectives.program import Exchange

T = TypeVar("T")


class HostLinks:
    """`Links` of all strategies on a CPU, and of those that go through the host on a GPU.

    A program waits in its exchanges for the other ranks, so calls return when it is computed.

    Args:
      host: this rank's use of the shared block, and of the connections between nodes.
      num_floats: P, length of the largest buffer.
    """

    def __init__(self, host: HostExchange | NodeExchange, num_floats: int) -> None:
        self.room = num_floats
        self._host = host
        self._failure: GmijaxError | None = None
        self._exchange_s = 0.0

    def start(self, exchange: Exchange) -> None:
        """Does nothing: there is nothing to agree on."""

    def reduce(
        self, stage: Stage, stream: int, place: int, source: int, target: int, num_floats: int
    ) -> None:
        """See `Links`."""
        rows = max(map(len, stage.groups)) if stage.kind == "gather" else 1
        calls = {
            "sum": self._host.sum,
            "gather": self._host.gather,
            "broadcast": self._host.broadcast,
        }

        def reduce(values: FloatBuffer, result: FloatBuffer) -> None:
            if stage.link == "nodes":
                assert isinstance(self._host, NodeExchange)
                self._host.sum_between_nodes(values, result, place)
                return
            if stage.kind == "gather":
                result = result.reshape(rows, -1)
            calls[stage.kind](values, result, stage.groups, place)

        self._exchange(reduce, stream, source, num_floats, target, rows)

    def run(self, program: Callable[[], T], *, is_last: bool) -> T:
        """See `Links`."""
        del is_last
        return self._explained(lambda: jax.block_until_ready(program()))

    def _explained(self, program: Callable[[], T]) -> T:
        try:
            return program()
        except jax.errors.JaxRuntimeError:
            if self._failure is not None:  # XLA keeps its words only.
                raise self._failure from None
            raise

    def exchange_s(self) -> float:
        """See `Links`."""
        seconds, self._exchange_s = self._exchange_s, 0.0
        return seconds

    def close(self) -> None:
        """Does nothing: the shared block is the reducer's."""

    def _exchange(
        self,
        call: Callable[[FloatBuffer, FloatBuffer], None],
        stream: int,
        source: int,
        num_floats: int,
        target: int,
        rows: int,
    ) -> None:
        started = time.monotonic()
        try:
            if stream:
                from gmijax.collectives.device.cuda_queue import fetch, store

                result = np.empty(rows * num_floats, np.float32)
                call(fetch(stream, source, num_floats), result)
                store(stream, target, result)
            else:
                call(_at(source, num_floats), _at(target, rows * num_floats))
        except GmijaxError as error:
            self._failure = error
            raise
        self._exchange_s += time.monotonic() - started


def _at(address: int, num_floats: int) -> FloatBuffer:
    return np.ctypeslib.as_array((ctypes.c_float * num_floats).from_address(address))
