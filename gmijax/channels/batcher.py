"""Batcher, on the trainer's side: slices or stacks what arrives to batches (section 4.2)."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.channels.compressor import Transfer
from gmijax.channels.pipe import Message
from gmijax.channels.spec import Array, Spec
from gmijax.channels.transport import ChannelReader
from gmijax.clock import running_s
from gmijax.collectives.waits import LIVENESS_PERIOD_S, wait_until
from gmijax.errors import CollectiveError, CollectiveTimeout, GmijaxError, PipeClosed

Decode: TypeAlias = Callable[[Message], Transfer | None]
"""Reads a message of one agent; None if it only began or continued a transfer."""


class Batch(NamedTuple):
    """What a trainer gets: whole unrolls of B environments.

    Attributes:
      experience: arrays by channel, [S, B, ...]; read-only views that are valid until the next
        `receive`, of host memory or of the device's. The latter are for programs: the same view
        comes again with other values, and jax keeps what `np.asarray` once read of it.
      versions: [B] int64, the policy version that every unroll was made with.
      agents: [B] int64, ranks of the agents that made them.
    """

    experience: dict[str, Array]
    versions: npt.NDArray[np.int64]
    agents: npt.NDArray[np.int64]


class Batcher:
    """A trainer's end of the channels: makes batches of unrolls from several agents, in turn.

    A batch that lies in one transfer is a slice of it, without a copy, and holds its memory until
    the next batch is asked for. Otherwise unrolls are stacked in what `new_stack` makes.
    It counts `batches` given out, `unrolls` and `transfers` that arrived.
    """

    def __init__(
        self,
        rank: int,
        sources: Sequence[tuple[ChannelReader, Decode]],
        new_stack: Callable[[Spec, int], Stack],
        held: contextlib.ExitStack,
    ) -> None:
        self.batches = self.unrolls = self.transfers = 0
        self._rank = rank
        self._sources = list(sources)
        self._turn = 0
        self._new_stack = new_stack
        self._held = held
        self._current: _Arrival | None = None
        self._stack: Stack | None = None
        self._next_look_s = time.monotonic() + LIVENESS_PERIOD_S

    def receive(self, batch_size: int, timeout_s: float) -> Batch:
        """Waits for the unrolls of `batch_size` environments.

        After any error nothing is lost: what had arrived is in the next batch. An agent that is
        gone is named at most five times a second, also while others still send; who can do
        without it goes on.

        Raises:
          CollectiveTimeout: too few came in time.
          PeerLost: the process of an agent is gone.
          PipeClosed: all agents have closed, and too few are left.
          CollectiveError: a message is damaged.
        """
        if time.monotonic() >= self._next_look_s and (error := self._why_lost()) is not None:
            raise error
        self._resize(batch_size)
        deadline_s = running_s() + timeout_s
        while True:
            arrival = self._arrival(deadline_s, timeout_s)
            filled = self._stack.filled if self._stack is not None else 0
            if not filled and arrival.left >= batch_size:
                batch = arrival.take(batch_size)
                break
            if self._stack is None or not self._stack.fits(arrival.spec):
                self._stack = self._new_stack(arrival.spec, batch_size)
            self._stack.add(arrival.take(min(batch_size - filled, arrival.left)))
            if not arrival.left:
                self._release()
            if self._stack.filled == batch_size:
                batch = self._stack.give()
                break
        self.batches += 1
        return batch

    def close(self) -> None:
        """Tells the agents that nothing more is wanted. Idempotent."""
        self._held.close()

    def _arrival(self, deadline_s: float, timeout_s: float) -> _Arrival:
        """What has unrolls left: the arrival in use, or the next one."""
        if self._current is not None and self._current.left:
            return self._current
        self._release()
        arrival = wait_until(self._next, self._why_lost, deadline_s - running_s())
        if arrival is None:
            peers = tuple(reader.peer for reader, _ in self._sources)
            raise CollectiveTimeout(self._rank, peers, "receive", self.batches, timeout_s)
        self._current = arrival
        return arrival

    def _next(self) -> _Arrival | None:
        for place in range(len(self._sources)):
            source = self._sources[(self._turn + place) % len(self._sources)]
            try:
                transfer = self._read(*source)
            except PipeClosed:
                if len(self._sources) == 1:
                    raise
                self._sources.remove(source)
                return self._next()
            if transfer is not None:
                self._turn += place + 1
                self.unrolls += transfer.num_envs
                agents = np.full(transfer.num_envs, source[0].peer, np.int64)
                return _Arrival(transfer, agents, source[0].release)
        return None

    def _read(self, reader: ChannelReader, decode: Decode) -> Transfer | None:
        """The next transfer, valid until the reader's `release`; PipeClosed if none can come."""
        while (message := reader.try_get()) is not None:
            self.transfers += 1
            if (transfer := decode(message)) is not None:
                return transfer
        return None

    def _why_lost(self) -> GmijaxError | None:
        self._next_look_s = time.monotonic() + LIVENESS_PERIOD_S
        found = (reader.why_lost("receive", self.batches) for reader, _ in self._sources)
        # One that has closed is no loss: `_next` finds out when its last message is read.
        lost = (error for error in found if not isinstance(error, PipeClosed))
        return next((error for error in lost if error is not None), None)

    def _resize(self, batch_size: int) -> None:
        """Makes what is stacked for batches of another size the first of the next arrivals."""
        if batch_size < 1:
            raise CollectiveError(f"batch_size={batch_size}: must be at least 1")
        stack = self._stack
        if stack is None or stack.size == batch_size:
            return
        self._stack = None
        if stack.filled:  # Then nothing is left of the last arrival.
            self._current = stack.as_arrival()

    def _release(self) -> None:
        if self._current is not None:
            self._current.release()
            self._current = None


@dataclass
class _Arrival:
    """A transfer of which a part may be in batches already; `left` unrolls are not."""

    transfer: Transfer
    agents: npt.NDArray[np.int64]
    release: Callable[[], None]

    def __post_init__(self) -> None:
        self.spec, self.left = self.transfer.spec, self.transfer.num_envs

    def take(self, count: int) -> Batch:
        """The next unrolls, which a trainer may not write into."""
        low = self.transfer.num_envs - self.left
        high = low + count
        self.left -= count
        arrays = self.transfer.arrays
        if count < self.transfer.num_envs:  # A part of an array on a device is a copy.
            arrays = {name: array[:, low:high] for name, array in arrays.items()}
        experience = {name: _read_only(array) for name, array in arrays.items()}
        return Batch(experience, self.transfer.versions[low:high], self.agents[low:high])


class Stack:
    """A batch of `size` unrolls from several arrivals, here in host memory; `filled` are in it."""

    def __init__(self, spec: Spec, size: int) -> None:
        self.spec, self.size = spec, size
        self.filled = 0
        self._versions, self._agents = np.zeros(size, np.int64), np.zeros(size, np.int64)
        self._arrays: dict[str, Array] = {}
        self._begin()

    def fits(self, spec: Spec) -> bool:
        """Whether unrolls of `spec` can be added; agents that differ cannot share a batch."""
        fits = spec == self.spec
        if self.filled and not fits:
            raise CollectiveError(f"agents send different experience: {spec} and {self.spec}")
        return fits

    def add(self, unrolls: Batch) -> None:
        """Takes unrolls in; their arrays may change after that."""
        low, high = self.filled, self.filled + len(unrolls.versions)
        for name, array in unrolls.experience.items():
            self._put(name, low, high, array)
        self._versions[low:high] = unrolls.versions
        self._agents[low:high] = unrolls.agents
        self.filled = high

    def give(self) -> Batch:
        """The batch, which is full; the next one begins."""
        experience = self._so_far()
        self.filled = 0
        self._begin()
        return Batch(experience, self._versions.copy(), self._agents.copy())

    def as_arrival(self) -> _Arrival:
        """What is in it so far, as if it had just come."""
        transfer = Transfer(self.spec, self.filled, self._versions[: self.filled], self._so_far())
        return _Arrival(transfer, self._agents[: self.filled], lambda: None)

    def _begin(self) -> None:
        """Makes room for a batch; the last one's memory may be used again."""
        self._arrays = self._arrays or {
            channel.name: np.empty(channel.full_shape(self.size), channel.dtype)
            for channel in self.spec.channels
        }

    def _put(self, name: str, low: int, high: int, array: Array) -> None:
        """Takes in unrolls `low` to `high` of a channel."""
        self._arrays[name][:, low:high] = array

    def _so_far(self) -> dict[str, Array]:
        """The unrolls that are in it, by channel."""
        return {name: _read_only(array[:, : self.filled]) for name, array in self._arrays.items()}


def _read_only(array: Array) -> Array:
    """A view that nobody can write into; of an array on a device nobody can anyway."""
    if not isinstance(array, np.ndarray):
        return array
    view = array.view()
    view.flags.writeable = False
    return view
