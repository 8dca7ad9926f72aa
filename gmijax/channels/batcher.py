"""Batcher, on the trainer's side: slices or stacks what arrives to batches (section 4.2)."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from gmijax.channels.experience import Array, Rollouts, Spec
from gmijax.channels.pipe import Message, PipeReader
from gmijax.channels.tcp_channel import RemoteReader
from gmijax.clock import running_s
from gmijax.collectives.waits import LIVENESS_PERIOD_S, wait_until
from gmijax.errors import CollectiveError, CollectiveTimeout, GmijaxError, PipeClosed

ChannelReader: TypeAlias = PipeReader | RemoteReader
"""The way from agent `peer` to this trainer: in shared memory, or over TCP."""

Decode: TypeAlias = Callable[[Message, int], Rollouts | None]
"""Reads a message of the agent of this rank; None if it only began or continued a transfer."""


class Batcher:
    """A trainer's end of the channels: makes batches of rollouts from several agents, in turn.

    A batch that lies in one transfer is a slice of it, without a copy, and holds its memory until
    the next batch is asked for. Otherwise rollouts are stacked in what `new_stack` makes.
    It counts `batches` given out and `unrolls` that arrived.
    """

    def __init__(
        self,
        rank: int,
        sources: Sequence[tuple[ChannelReader, Decode]],
        new_stack: Callable[[Spec, int], Stack],
        held: contextlib.ExitStack,
    ) -> None:
        self.batches = self.unrolls = 0
        self._rank = rank
        self._sources = list(sources)
        self._turn = 0
        self._new_stack = new_stack
        self._held = held
        # The transfer in use, how many of its rollouts are in batches, and what to do after it.
        self._current: Rollouts | None = None
        self._taken = 0
        self._release_current: Callable[[], None] | None = None
        self._stack: Stack | None = None
        self._next_look_s = time.monotonic() + LIVENESS_PERIOD_S

    def receive(self, batch_size: int, timeout_s: float) -> Rollouts:
        """Waits for the rollouts of `batch_size` environments.

        Its arrays are read-only, and valid until the next call. Those of the device are for
        programs: the same view comes again with other values, and jax keeps what `np.asarray`
        once read of it.

        After any error nothing is lost: what had arrived is in the next batch. An agent that is
        gone is named at most five times a second, also while others still send; a caller may
        catch the error and continue without it.

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
            current = self._await_rollouts(deadline_s, timeout_s)
            left = current.num_envs - self._taken
            filled = self._stack.filled if self._stack is not None else 0
            if not filled and left >= batch_size:
                batch = self._take(batch_size)
                break
            if self._stack is None or not self._stack.fits(current.spec):
                self._stack = self._new_stack(current.spec, batch_size)
            self._stack.add(self._take(min(batch_size - filled, left)))
            if self._taken == current.num_envs:
                self._release()
            if self._stack.filled == batch_size:
                batch = self._stack.give()
                break
        self.batches += 1
        return batch

    def close(self) -> None:
        """Makes the agents stop: nothing more is read. Idempotent."""
        self._held.close()

    def _await_rollouts(self, deadline_s: float, timeout_s: float) -> Rollouts:
        """The transfer in use if some of it is left, or the next one."""
        if self._current is not None and self._taken < self._current.num_envs:
            return self._current
        self._release()
        self._current = wait_until(self._next, self._why_lost, deadline_s - running_s())
        if self._current is None:
            peers = tuple(reader.peer for reader, _ in self._sources)
            raise CollectiveTimeout(self._rank, peers, "receive", self.batches, timeout_s)
        return self._current

    def _next(self) -> Rollouts | None:
        """The next transfer of an agent, in turn."""
        for index in range(len(self._sources)):
            source = self._sources[(self._turn + index) % len(self._sources)]
            try:
                rollouts = self._read(*source)
            except PipeClosed:
                if len(self._sources) == 1:
                    raise
                self._sources.remove(source)
                return self._next()
            if rollouts is not None:
                self._turn += index + 1
                self.unrolls += rollouts.num_envs
                self._release_current = source[0].release
                return rollouts
        return None

    def _take(self, count: int) -> Rollouts:
        """The next rollouts of the transfer in use, which a trainer may not write into."""
        assert self._current is not None
        part = self._current.part(self._taken, self._taken + count)
        self._taken += count
        experience = {name: _read_only(array) for name, array in part.experience.items()}
        return part._replace(experience=experience)

    def _read(self, reader: ChannelReader, decode: Decode) -> Rollouts | None:
        """The next transfer, valid until the reader's `release`; PipeClosed if none can come."""
        while (message := reader.try_get()) is not None:
            if (rollouts := decode(message, reader.peer)) is not None:
                return rollouts
        return None

    def _why_lost(self) -> GmijaxError | None:
        self._next_look_s = time.monotonic() + LIVENESS_PERIOD_S
        found = (reader.why_lost("receive", self.batches) for reader, _ in self._sources)
        # One that has closed is no loss: `_next` finds out when its last message is read.
        lost = (error for error in found if not isinstance(error, PipeClosed))
        return next((error for error in lost if error is not None), None)

    def _resize(self, batch_size: int) -> None:
        """Makes what is stacked for batches of another size the first of the next transfers."""
        if batch_size < 1:
            raise CollectiveError(f"batch_size={batch_size}: must be at least 1")
        stack = self._stack
        if stack is None or stack.size == batch_size:
            return
        self._stack = None
        if stack.filled:  # Then nothing is left of the last transfer.
            self._current = stack.so_far()

    def _release(self) -> None:
        """Gives the memory of the transfer in use back to its agent."""
        self._current, self._taken = None, 0
        if self._release_current is not None:
            self._release_current()
        self._release_current = None


class Stack:
    """A batch of `size` rollouts of several transfers, in host memory; `filled` are in it."""

    def __init__(self, spec: Spec, size: int) -> None:
        self.spec, self.size = spec, size
        self.filled = 0
        self._versions, self._agents = np.zeros(size, np.int64), np.zeros(size, np.int64)
        self._arrays: dict[str, Array] = {}
        self._begin()

    def fits(self, spec: Spec) -> bool:
        """Whether rollouts of `spec` can be added; agents that differ cannot share a batch."""
        fits = spec == self.spec
        if self.filled and not fits:
            raise CollectiveError(f"agents send different experience: {spec} and {self.spec}")
        return fits

    def add(self, rollouts: Rollouts) -> None:
        """Takes rollouts in; their arrays may change after that."""
        low, high = self.filled, self.filled + len(rollouts.versions)
        for name, array in rollouts.experience.items():
            self._put(name, low, high, array)
        self._versions[low:high] = rollouts.versions
        self._agents[low:high] = rollouts.agents
        self.filled = high

    def give(self) -> Rollouts:
        """The batch, which is full; the next one begins."""
        batch = self.so_far()
        self.filled = 0
        self._begin()
        return batch

    def so_far(self) -> Rollouts:
        """The rollouts that are in it."""
        versions, agents = self._versions[: self.filled], self._agents[: self.filled]
        return Rollouts(self.spec, self._so_far(), versions.copy(), agents.copy())

    def _begin(self) -> None:
        """Prepares memory for a batch; that of the last one may be used again."""
        self._arrays = self._arrays or {
            channel.name: np.empty(channel.full_shape(self.size), channel.dtype)
            for channel in self.spec.channels
        }

    def _put(self, name: str, low: int, high: int, array: Array) -> None:
        """Adds rollouts `low` to `high` of a channel."""
        self._arrays[name][:, low:high] = array

    def _so_far(self) -> dict[str, Array]:
        """What is in it, by channel."""
        return {name: _read_only(array[:, : self.filled]) for name, array in self._arrays.items()}


def _read_only(array: Array) -> Array:
    """A read-only view; an array on a device is read-only anyway."""
    if not isinstance(array, np.ndarray):
        return array
    view = array.view()
    view.flags.writeable = False
    return view
