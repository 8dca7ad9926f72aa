"""Slots in device memory that several ranks map: all write theirs, meet, and sum what is there."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmijax.collectives.device_memory import (
    TICKET_BYTES,
    DeviceMemory,
    DeviceQueue,
    NewMemory,
)
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.sums import ordered_sum
from gmijax.collectives.turns import Turns
from gmijax.collectives.waits import fence, wait_until
from gmijax.errors import DeviceMemoryUnavailable, PeerLost

NOTE_BYTES = 240
"""What a rank tells the others at each step of the start: a ticket, or why it failed."""

CLOSE_S = 10.0
"""How long an owner waits for others that still use its memory; longer than a last step takes."""

FLOATS_PER_ROW_UNIT = 64
"""Slots begin at multiples of 256 bytes, as allocations of jax do."""

_TRIAL_RESULT = 7.0


class SharedSlots:
    """One rank's use of blocks of device memory: two slots for each member, and one result.

    The two slots are used in turn, so that one meeting of all ranks suffices for a sum: a rank
    that writes a slot again has passed the meeting in between, before which all had finished
    reading. The result is written after the meeting of a sum, and read after one more.

    All ranks of the job make theirs together. In three steps blocks are made, mapped and filled
    with known numbers, and read back through the programs that training will use.

    Args:
      host: this rank's use of the shared block, to hand the blocks around.
      num_floats: P, length of a slot.
      members: ranks that have slots in each block, in the order of sums; this one among them.
      owners: ranks that make the blocks which this one writes; the first one's is on its own GPU.
      scale: what sums will be multiplied with.
      new_memory: how the processes share a block.
      wish: what cannot be had if this fails, for the message.

    Attributes:
      num_floats: the same.

    Raises:
      DeviceMemoryUnavailable: there is no such memory here, or it does not hold what was
        written; on all ranks alike.
      PeerLost, CollectiveTimeout: as in the first call of a reducer.
    """

    def __init__(
        self,
        host: HostExchange,
        num_floats: int,
        members: Sequence[int],
        owners: Sequence[int],
        scale: float,
        new_memory: NewMemory,
        wish: str,
    ) -> None:
        self.num_floats = num_floats
        self._row_floats = -(-num_floats // FLOATS_PER_ROW_UNIT) * FLOATS_PER_ROW_UNIT
        self._members, self._rank = tuple(members), host.rank
        self._count, self._place = len(members), members.index(host.rank)
        row_bytes = self._row_floats * 4
        self._half_bytes = self._count * row_bytes
        self._own = [half * self._half_bytes + self._place * row_bytes for half in (0, 1)]
        self._result_offset = 2 * self._half_bytes
        self._owners, self._is_owner = tuple(owners), host.rank == owners[0]
        self._memories: list[DeviceMemory] = []
        self._slots: list[jax.Array] = []
        self._result: jax.Array | None = None
        self._num_writes = 0
        self._host: HostExchange | None = host
        host.flags[host.rank, 1] = 0
        # An output of the program that read the block last; the caller owns the others.
        self._read: jax.Array | None = None
        self._sum = jax.jit(functools.partial(_sum, num_floats), static_argnums=1)
        self._copy = jax.jit(_copy)
        size = self._result_offset + row_bytes
        try:
            tickets = agreed(host, wish, lambda: self._make(new_memory, size))
            agreed(host, wish, lambda: self._map(tickets))
            agreed(host, wish, lambda: self._try(scale))
        except BaseException:
            self.close()
            raise

    def write(self, buffer: jax.Array, turns: Turns) -> None:
        """Puts `buffer` [P] into this rank's slots, and meets all ranks.

        Raises:
          CollectiveError: other ranks make another call, or the copy failed.
          PeerLost, CollectiveTimeout: as `Turns.meet`.
        """
        self._num_writes += 1
        offset = self._own[self._num_writes % 2]
        with turns.explained():
            self._finish_reading()
            for memory in self._memories:
                memory.start_write(offset, buffer)
            for memory in self._memories:
                memory.finish_writes()
        turns.meet()
        turns.check_same_call()

    def sum(self, turns: Turns, scale: float) -> jax.Array:
        """The sum [P] of what all members wrote, times `scale`; it may still be computed."""
        with turns.explained():
            total, self._read = self._sum(self._slots[self._num_writes % 2], scale)
        return total

    def write_result(self, result: jax.Array, turns: Turns) -> None:
        """Puts `result` [P] into the block of this GPU; only its owner may."""
        with turns.explained():
            self._memories[0].write(self._result_offset, result)

    def read_result(self, turns: Turns) -> jax.Array:
        """A copy of the result of this GPU's block; it may still be computed."""
        with turns.explained():
            copied, self._read = self._copy(self._result)
        return copied

    def queue(self, flags: npt.NDArray[np.uint32]) -> DeviceQueue:
        """For `gather`; see `DeviceMemory.queue`."""
        self._finish_reading()
        return self._memories[0].queue(flags)

    def gather(
        self, queue: DeviceQueue, stream: int, source: int, target: int, num_floats: int
    ) -> None:
        """Queues a write, and a copy of what all members wrote.

        Args:
          queue: of these slots.
          stream: of the device, where it is queued.
          source: address of [n] float32, n <= P.
          target: address of [members, n] float32.
          num_floats: n.
        """
        self._num_writes += 1
        half, count = self._num_writes % 2, self._num_writes & 0xFFFFFFFF
        queue.start_clock(stream)
        for memory in self._memories:
            queue.copy(stream, memory.address + self._own[half], source, 4 * num_floats)
        queue.raise_flag(stream, self._rank, count)
        for member in self._members:
            if member != self._rank:
                queue.wait_for_flag(stream, member, count)
        slots = self._memories[0].address + half * self._half_bytes
        pitch = 4 * self._row_floats
        queue.copy_rows(stream, target, slots, pitch, 4 * num_floats, self._count)
        queue.stop_clock(stream)

    def restart(self) -> None:
        """Begins again with the same one of the two slots on all ranks, when none is at work."""
        self._num_writes = 0

    def close(self) -> None:
        """Gives the mappings back; calling it twice is fine.

        A block goes with its owner's process, so an owner first waits for all members to be
        through with it; not if an error is what ends it, or `CLOSE_S` are over.
        """
        with suppress(jax.errors.JaxRuntimeError):  # Why the job fails is known already.
            self._finish_reading()
        self._slots, self._result = [], None
        if self._host is not None:
            fence()
            self._host.flags[self._rank, 1] = 1
            if self._is_owner and sys.exception() is None:
                self._wait_for_members(self._host)
            self._host = None
        for memory in self._memories:
            memory.close()
        self._memories = []

    def _wait_for_members(self, host: HostExchange) -> None:
        def late() -> list[int]:
            return [member for member in self._members if not host.flags[member, 1]]

        def lost() -> PeerLost | None:
            gone = [member for member in late() if host.is_gone(member)]
            return PeerLost(self._rank, gone[0], "close", 0) if gone else None

        with suppress(PeerLost):
            wait_until(lambda: None if late() else True, lost, CLOSE_S)

    def _make(self, new_memory: NewMemory, num_bytes: int) -> bytes:
        for _ in self._owners:  # One by one, so that those before one that fails are closed.
            self._memories.append(new_memory())
        return self._memories[0].create(num_bytes) if self._is_owner else b""

    def _map(self, tickets: npt.NDArray[np.uint8]) -> bytes:
        """Opens the blocks, and writes what `_try` expects in them."""
        for owner, memory in zip(self._owners, self._memories, strict=True):
            if not (self._is_owner and owner == self._owners[0]):
                memory.open(tickets[owner][:TICKET_BYTES].tobytes())
            for half in (0, 1):
                memory.write(self._own[half], self._filled((half + 1) * (self._place + 1)))
        near, shape = self._memories[0], (self._count, self._row_floats)
        self._slots = [near.view(half * self._half_bytes, shape) for half in (0, 1)]
        self._result = near.view(self._result_offset, (self.num_floats,))
        if self._is_owner:
            near.write(self._result_offset, self._filled(_TRIAL_RESULT))
        return b""

    def _try(self, scale: float) -> bytes:
        """Reads what all have written, and compiles."""
        whole = scale * self._count * (self._count + 1) / 2
        for half in (0, 1):
            total, _ = self._sum(self._slots[half], scale)
            _require_equal(total, (half + 1) * whole)
        _require_equal(self._copy(self._result)[0], _TRIAL_RESULT)
        return b""

    def _filled(self, value: float) -> jax.Array:
        return jax.device_put(np.full(self.num_floats, value, np.float32))

    def _finish_reading(self) -> None:
        if self._read is not None:
            self._read.block_until_ready()
            self._read = None


def agreed(host: HostExchange, wish: str, step: Callable[[], bytes]) -> npt.NDArray[np.uint8]:
    """Does a step of the start; returns what it returned on every rank [K, NOTE_BYTES].

    All ranks of the job call this, and they go on together or not at all.

    Raises:
      DeviceMemoryUnavailable: it failed on one of them, and why it did there.
    """
    try:
        note, has_failed = step(), False
    # Whatever it is, of CUDA, of jax or of an import: there is another way, through the host.
    except Exception as error:
        said = " ".join(str(error).split())
        note, has_failed = f"{said or type(error).__name__}".encode()[:NOTE_BYTES], True
    sent = np.zeros(1 + NOTE_BYTES, np.float32)  # One number a byte: no float has odd bits.
    sent[0] = has_failed
    sent[1 : 1 + len(note)] = np.frombuffer(note, np.uint8)
    everyone: FloatBuffer = host.introduce(sent)
    notes = everyone[:, 1:].astype(np.uint8)
    if failed := np.flatnonzero(everyone[:, 0]).tolist():
        why = notes[failed[0]].tobytes().rstrip(b"\0").decode(errors="replace")
        raise DeviceMemoryUnavailable(f"{wish}: rank {failed[0]}: {why}")
    return notes


def _require_equal(found: jax.Array, expected: float) -> None:
    if not np.allclose(np.asarray(found), expected, rtol=1e-5, atol=0.0):
        raise RuntimeError("shared GPU memory does not hold what was written into it")


def _sum(num_floats: int, slots: jax.Array, scale: float) -> tuple[jax.Array, jax.Array]:
    total = ordered_sum(slots[:, :num_floats], scale)
    return total, total[:1]


def _copy(result: jax.Array) -> tuple[jax.Array, jax.Array]:
    copied = jnp.copy(result)
    return copied, copied[:1]
