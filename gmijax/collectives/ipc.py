"""HAR's exchange inside a GPU without leaving it: memory of the GPU that all its GMIs map."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.intra import IntraUnavailable
from gmijax.collectives.memory import ExchangeBlock
from gmijax.collectives.mrr import explained
from gmijax.collectives.turns import Turns
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import is_even, leaders

TICKET_BYTES = 64
"""Room for what another process needs to open a block."""

NOTE_BYTES = 240
"""What a rank tells the others at each step of the start: a ticket, or why it failed."""

FLOATS_PER_ROW_UNIT = 64
"""Slots begin at multiples of 256 bytes, as allocations of jax do."""

_TRIAL_MEAN = 7.0


class DeviceMemory(Protocol):
    """A block of device memory for the processes of one GPU; `CudaMemory` is the real one."""

    def create(self, num_bytes: int) -> bytes:
        """Makes the block; returns what another process needs to open it."""
        ...

    def open(self, ticket: bytes) -> None:
        """Maps the block that another process has made."""
        ...

    def write(self, offset: int, values: jax.Array) -> None:
        """Copies `values` to `offset` bytes; on return they are there for all processes."""
        ...

    def view(
        self, offset: int, shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32
    ) -> jax.Array:
        """The array at `offset` bytes in place: a program reads what is there when it runs."""
        ...

    def close(self) -> None:
        """Gives the mapping back; no view may be in use."""
        ...


NewMemory: TypeAlias = Callable[[], DeviceMemory]
"""How the processes of a GPU share a block: `CudaMemory`, or what a test puts in its place."""


class IpcIntra:
    """Through a block of device memory that the leader makes: two slots a GMI, one result.

    With one GPU, or as many GMIs on all, every rank writes its slot, they meet, and every rank
    sums all slots of its GPU, in the same order. The two slots are used in turn, so that one
    meeting suffices: a rank that writes a slot again has passed the meeting in between, before
    which all had finished reading.

    With other layouts the leaders alone sum. `spread`: they write the mean into the result; all
    meet; the others copy it. It is written again after the next call's first meeting, before
    which all had finished copying.

    Args:
      layout: where all GMIs live.
      rank: this one.
      num_floats: P, length of the buffers.
      host: this rank's use of the shared block, to hand the block around.
      new_memory: how the processes share the block.

    Raises:
      IntraUnavailable: there is no such memory here, or it does not hold what was written; on
        all ranks alike.
      PeerLost, CollectiveTimeout: as in the first call of a reducer.
    """

    is_device_resident = True

    def __init__(
        self,
        layout: Layout,
        rank: int,
        num_floats: int,
        host: HostExchange,
        new_memory: NewMemory,
    ) -> None:
        neighbours = layout.neighbours_of(rank)
        leader = leaders(layout)[layout.gpu_of(rank)]
        self._count = len(neighbours)
        self.all_sum = is_even(layout)
        self._sums = self.all_sum or rank == leader
        self._memory: DeviceMemory | None = None
        self._slots: list[jax.Array] = []
        self._mean: jax.Array | None = None
        self._num_means = 0
        # An output of the program that read the block last; the caller owns the others.
        self._read: jax.Array | None = None
        self._num_floats = num_floats
        self._row_floats = -(-num_floats // FLOATS_PER_ROW_UNIT) * FLOATS_PER_ROW_UNIT
        row_bytes, self._place = self._row_floats * 4, neighbours.index(rank)
        self._half_bytes = self._count * row_bytes
        self._own = [half * self._half_bytes + self._place * row_bytes for half in (0, 1)]
        self._result = 2 * self._half_bytes
        self._total = jax.jit(functools.partial(_total, num_floats), static_argnums=1)
        self._copy = jax.jit(_copy)
        try:
            tickets = _agreed(
                host, lambda: self._make(new_memory, self._result + row_bytes, rank == leader)
            )
            ticket = tickets[leader][:TICKET_BYTES].tobytes()
            _agreed(host, lambda: self._map(None if rank == leader else ticket))
            _agreed(host, lambda: self._try(1.0 / self._count if self.all_sum else 1.0))
        except IntraUnavailable:
            self.close()
            raise

    def _make(self, new_memory: NewMemory, num_bytes: int, is_leader: bool) -> bytes:
        self._memory = new_memory()
        return self._memory.create(num_bytes) if is_leader else b""

    def _map(self, ticket: bytes | None) -> bytes:
        """Makes the views, and writes what `_try` expects in them."""
        memory = self._opened()
        if ticket is not None:
            memory.open(ticket)
        shape = (self._count, self._row_floats)
        self._slots = [memory.view(half * self._half_bytes, shape) for half in (0, 1)]
        self._mean = memory.view(self._result, (self._num_floats,))
        for half in (0, 1):
            memory.write(self._own[half], self._filled((half + 1) * (self._place + 1)))
        if ticket is None:
            memory.write(self._result, self._filled(_TRIAL_MEAN))
        return b""

    def _try(self, scale: float) -> bytes:
        """Reads what all have written, and compiles."""
        whole = scale * self._count * (self._count + 1) / 2
        for half in (0, 1):
            total, _ = self._total(self._slots[half], scale)
            _require_equal(total, (half + 1) * whole)
        _require_equal(self._copy(self._mean)[0], _TRIAL_MEAN)
        return b""

    def _filled(self, value: float) -> jax.Array:
        return jax.device_put(np.full(self._num_floats, value, np.float32))

    def _opened(self) -> DeviceMemory:
        assert self._memory is not None
        return self._memory

    def sum(
        self, buffer: jax.Array, block: ExchangeBlock, turns: Turns, scale: float
    ) -> jax.Array | None:
        """See `IntraExchange`; with an even layout every rank gets the sum."""
        del block
        self._num_means += 1
        half = self._num_means % 2
        with explained(turns):
            self._finish_reading()
            self._opened().write(self._own[half], buffer)
        turns.meet()
        turns.check_same_call()
        if not self._sums:
            return None
        with explained(turns):
            total, self._read = self._total(self._slots[half], scale)
        return total

    def spread(self, mean: jax.Array | None, block: ExchangeBlock, turns: Turns) -> jax.Array:
        """See `IntraExchange`; the result may still be computed, and is the caller's own."""
        del block
        if self.all_sum and mean is not None:
            return mean
        if mean is not None:
            with explained(turns):
                self._opened().write(self._result, mean)
        turns.meet()
        if mean is not None:
            return mean
        with explained(turns):
            copied, self._read = self._copy(self._mean)
        return copied

    def close(self) -> None:
        """Gives the mapping back; calling it twice is fine."""
        if self._memory is not None:
            with suppress(jax.errors.JaxRuntimeError):  # Why the job fails is known already.
                self._finish_reading()
            self._slots, self._mean = [], None
            self._memory.close()
            self._memory = None

    def _finish_reading(self) -> None:
        if self._read is not None:
            self._read.block_until_ready()
            self._read = None


def _agreed(host: HostExchange, step: Callable[[], bytes]) -> npt.NDArray[np.uint8]:
    """Does a step of the start; returns what it returned on every rank [K, NOTE_BYTES].

    All ranks of the job call this, and they go on together or not at all.

    Raises:
      IntraUnavailable: it failed on one of them, and why it did there.
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
        raise IntraUnavailable(f"reduce.intra=ipc: rank {failed[0]}: {why}")
    return notes


def _require_equal(found: jax.Array, expected: float) -> None:
    if not np.allclose(np.asarray(found), expected, rtol=1e-5, atol=0.0):
        raise RuntimeError("shared GPU memory does not hold what was written into it")


def _total(num_floats: int, slots: jax.Array, scale: float) -> tuple[jax.Array, jax.Array]:
    # Written out, so that it is one pass in a fixed order, not a reduction in some order.
    total = functools.reduce(jnp.add, list(slots[:, :num_floats]))
    total = total * np.float32(scale)
    return total, total[:1]


def _copy(mean: jax.Array) -> tuple[jax.Array, jax.Array]:
    copied = jnp.copy(mean)
    return copied, copied[:1]
