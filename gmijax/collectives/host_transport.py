"""Runs the stages of a reduction through shared memory of the host."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import numpy as np

from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.nodes.multi_node_group import MultiNodeGroup
from gmijax.collectives.strategies import ReductionStage
from gmijax.errors import GmijaxError

T = TypeVar("T")


class HostTransport:
    """Moves the numbers of one rank's collectives, here all of them through the host.

    So it is with all strategies on a CPU, and on a GPU with those that do not leave the host. A
    program waits in its exchanges for the other ranks, so calls return when it is computed.

    Args:
      host: this rank's use of the shared block, and of the connections between nodes.
      num_floats: P, length of the largest buffer; the attribute `capacity`.
    """

    def __init__(self, host: SharedMemoryGroup | MultiNodeGroup, num_floats: int) -> None:
        self.capacity = num_floats
        self._host = host
        self._failure: GmijaxError | None = None
        self._exchange_s = 0.0
        self._pinned: dict[str, FloatBuffer] = {}  # On a GPU: what exchanges go through.

    def start(self, checks: Sequence[Callable[[], bool]]) -> None:
        """Makes sure that it works, together with all other ranks.

        Args:
          checks: collectives, one after the other; whether their results are right.

        Raises:
          DeviceMemoryUnavailable: they do not work; on all ranks alike.
        """

    def reduce(
        self,
        stage: ReductionStage,
        stream: int,
        call_index: int,
        source: int,
        target: int,
        num_floats: int,
    ) -> None:
        """`target` becomes what the stage makes of `source`.

        Args:
          stage: of the strategy.
          stream: of the device, 0 on a CPU.
          call_index: which exchange of its program it is.
          source: address on the device of [n] float32.
          target: address of the result, [n], or [m, n] if the stage gathers.
          num_floats: n.
        """
        rows = max(map(len, stage.groups)) if stage.kind == "all_gather" else 1
        started = time.monotonic()
        try:
            if stream:
                from gmijax.collectives.device.cuda_queue import fetch, store, synchronize

                # Free again on return: `store` waits, and the host takes one exchange at a time.
                values = self._buffer("source", num_floats)
                result = self._buffer("target", rows * num_floats)
                if stage.reads(self._host.rank):
                    fetch(stream, source, values)
                else:  # A rank enters the barrier once it has computed, also without numbers.
                    synchronize(stream)
                self._reduce(stage, call_index, values, result)
                store(stream, target, result)
            else:
                values, result = _at(source, num_floats), _at(target, rows * num_floats)
                self._reduce(stage, call_index, values, result)
        except GmijaxError as error:
            self._failure = error
            raise
        self._exchange_s += time.monotonic() - started

    def run(self, program: Callable[[], T], *, is_last: bool) -> T:
        """Runs a program that has exchanges in it, or (`is_last`) waits for the last one.

        Raises:
          PeerLost, CollectiveTimeout, CollectiveError: see `TracedStep`.
        """
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
        """Seconds of the exchanges that have ended since the last call."""
        seconds, self._exchange_s = self._exchange_s, 0.0
        return seconds

    def close(self) -> None:
        """Releases what it holds beside the shared block, which is the communicator's."""
        self._pinned = {}

    def _buffer(self, use: str, num_floats: int) -> FloatBuffer:
        """[n] in host memory, the same for each exchange: new memory costs page faults."""
        from gmijax.collectives.device.cuda_queue import pinned

        if use not in self._pinned or self._pinned[use].size < num_floats:
            self._pinned[use] = pinned(num_floats)
        return self._pinned[use][:num_floats]

    def _reduce(
        self, stage: ReductionStage, call_index: int, values: FloatBuffer, result: FloatBuffer
    ) -> None:
        if stage.transport == "nodes":
            assert isinstance(self._host, MultiNodeGroup)
            self._host.all_reduce_nodes(values, result, stage.groups, call_index)
        elif stage.kind == "all_gather":
            rows = result.reshape(-1, values.size)
            self._host.all_gather_into(values, rows, stage.groups, call_index)
        elif stage.kind == "all_reduce":
            self._host.all_reduce(values, result, stage.groups, call_index)
        else:
            self._host.broadcast(values, result, stage.groups, call_index)


def _at(address: int, num_floats: int) -> FloatBuffer:
    return np.ctypeslib.as_array((ctypes.c_float * num_floats).from_address(address))
