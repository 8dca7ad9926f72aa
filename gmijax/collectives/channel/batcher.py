"""Batcher, on the trainer's side: slices or stacks what arrives to batches (section 4.2)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gmijax.collectives.channel.compressor import Transfer
from gmijax.collectives.channel.interface import Array, Batch
from gmijax.collectives.channel.spec import Spec
from gmijax.collectives.waits import LIVENESS_PERIOD_S, wait_until
from gmijax.errors import CollectiveError, CollectiveTimeout, GmijaxError, PipeClosed


class Source(Protocol):
    """Unrolls from one agent.

    Attributes:
      peer: rank of the agent.
    """

    peer: int

    def try_next(self) -> Transfer | None:
        """The next unrolls, valid until `release`; PipeClosed if no more can come."""
        ...

    def release(self) -> None:
        """Gives their memory back."""
        ...

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """Why the agent will never send again, None if it may."""
        ...


class Batcher:
    """Makes batches of unrolls from several agents, in turn.

    A batch that lies in one transfer is a slice of it, without a copy, and holds its memory until
    the next batch is asked for. Otherwise unrolls are stacked in memory of the batcher's own.

    Args:
      rank: of this trainer.
      sources: one for every agent.
      new_stack: makes, from a spec and a size, what batches of several arrivals are stacked in.
    """

    def __init__(
        self,
        rank: int,
        sources: Sequence[Source],
        new_stack: Callable[[Spec, int], Stack] | None = None,
    ) -> None:
        self.batches = self.unrolls = 0
        self.waited_s = 0.0
        self._rank = rank
        self._sources = list(sources)
        self._turn = 0
        self._new_stack = Stack if new_stack is None else new_stack
        self._current: _Arrival | None = None
        self._stack: Stack | None = None
        self._next_look_s = time.monotonic() + LIVENESS_PERIOD_S

    def receive(self, batch_size: int, timeout_s: float) -> Batch:
        """Waits for `batch_size` unrolls; see `ExperienceReceiver.receive`."""
        self._check_agents()
        self._resize(batch_size)
        deadline_s = time.monotonic() + timeout_s
        while True:
            arrival = self._arrival(deadline_s, timeout_s)
            filled = self._stack.filled if self._stack is not None else 0
            if not filled and arrival.left >= batch_size:
                batch = arrival.take(batch_size).batch()
                break
            if self._stack is None or not self._stack.fits(arrival.spec):
                self._stack = self._new_stack(arrival.spec.unpacked(), batch_size)
            self._stack.add(arrival.take(min(batch_size - filled, arrival.left)))
            if not arrival.left:
                self._release()
            if self._stack.filled == batch_size:
                batch = self._stack.give()
                break
        self.batches += 1
        return batch

    def _arrival(self, deadline_s: float, timeout_s: float) -> _Arrival:
        """What has unrolls left: the arrival in use, or the next one."""
        if self._current is not None and self._current.left:
            return self._current
        self._release()
        arrival = self._next()
        if arrival is None:
            arrival = self._wait(deadline_s, timeout_s)
        self.unrolls += arrival.left
        self._current = arrival
        return arrival

    def _wait(self, deadline_s: float, timeout_s: float) -> _Arrival:
        started_s = time.monotonic()
        try:
            arrival = wait_until(self._next, self._why_lost, deadline_s - started_s)
        finally:
            self.waited_s += time.monotonic() - started_s
        if arrival is None:
            peers = tuple(source.peer for source in self._sources)
            raise CollectiveTimeout(self._rank, peers, "receive", self.batches, timeout_s)
        return arrival

    def _next(self) -> _Arrival | None:
        for place in range(len(self._sources)):
            source = self._sources[(self._turn + place) % len(self._sources)]
            try:
                transfer = source.try_next()
            except PipeClosed:
                if len(self._sources) == 1:
                    raise
                self._sources.remove(source)
                return self._next()
            if transfer is not None:
                self._turn += place + 1
                return _Arrival(transfer, source.peer, source.release)
        return None

    def _why_lost(self) -> GmijaxError | None:
        self._next_look_s = time.monotonic() + LIVENESS_PERIOD_S
        found = (source.why_lost("receive", self.batches) for source in self._sources)
        # One that has closed is no loss: `_next` finds out when its last message is read.
        lost = (error for error in found if not isinstance(error, PipeClosed))
        return next((error for error in lost if error is not None), None)

    def _check_agents(self) -> None:
        if time.monotonic() >= self._next_look_s and (error := self._why_lost()) is not None:
            raise error

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


class _Unrolls(NamedTuple):
    """Some unrolls of one agent."""

    spec: Spec
    arrays: dict[str, Array]
    versions: npt.NDArray[np.int64]
    agents: npt.NDArray[np.int64]

    def batch(self) -> Batch:
        experience = {
            channel.name: _given(self.arrays[channel.name], channel.dtype)
            for channel in self.spec.channels
        }
        return Batch(experience, self.versions, self.agents)


class _Arrival:
    """A transfer of which a part may be in batches already."""

    def __init__(self, transfer: Transfer, agent: int | None, release: Callable[[], None]) -> None:
        self.spec = transfer.spec
        self.release = release
        self._transfer = transfer
        self._taken = 0
        self.agents = np.full(transfer.num_envs, -1 if agent is None else agent, np.int64)

    @property
    def left(self) -> int:
        return self._transfer.num_envs - self._taken

    def take(self, count: int) -> _Unrolls:
        low, high = self._taken, self._taken + count
        self._taken = high
        arrays = self._transfer.arrays
        if count < self._transfer.num_envs:  # A part of an array on a device is a copy.
            arrays = {name: array[:, low:high] for name, array in arrays.items()}
        return _Unrolls(
            self.spec, arrays, self._transfer.versions[low:high], self.agents[low:high]
        )


class Stack:
    """A batch that is put together from several arrivals, here in host memory.

    Args:
      spec: the channels.
      size: B, unrolls of the batch.

    Attributes:
      spec, size: the same.
      filled: unrolls that are in it.
    """

    def __init__(self, spec: Spec, size: int) -> None:
        self.spec, self.size = spec, size
        self.filled = 0
        self._versions, self._agents = np.zeros(size, np.int64), np.zeros(size, np.int64)
        self._arrays: dict[str, Array] = {}
        self._begin()

    def fits(self, spec: Spec) -> bool:
        """Whether unrolls of `spec` can be added; agents that differ cannot share a batch."""
        fits = spec.unpacked() == self.spec
        if self.filled and not fits:
            raise CollectiveError(f"agents send different experience: {spec} and {self.spec}")
        return fits

    def add(self, unrolls: _Unrolls) -> None:
        """Takes unrolls in; their arrays may change after that."""
        low, high = self.filled, self.filled + len(unrolls.versions)
        for name, array in unrolls.arrays.items():
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
        arrival = _Arrival(transfer, None, lambda: None)
        arrival.agents[:] = self._agents[: self.filled]
        return arrival

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


def _given(array: Array, dtype: str) -> Array:
    """An array as the trainer gets it, who may not write into it; one on a device nobody can."""
    if not isinstance(array, np.ndarray):
        return array
    return _read_only(array.astype(dtype, copy=False))


def _read_only(array: Array) -> Array:
    view = array.view()
    view.flags.writeable = False
    return view
