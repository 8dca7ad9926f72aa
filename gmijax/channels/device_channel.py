"""Experience that stays on the GPU: agents and trainers of one GPU share a block of its memory.

Every agent makes a block with slots for each trainer; a slot holds one rollout, an array a
channel. What travels through the pipe of shared memory is a note of where it lies, with sequence
number and checksum as any message. The trainer reads it in place, and the slot is free again when
it has released the note. So order, back-pressure and the discovery of the dead are the pipe's, and
no experience passes through the host. What lies in the slots has no checksum.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.channels.batcher import Stack
from gmijax.channels.experience import Rollouts, Spec
from gmijax.channels.migrator import Migrator
from gmijax.channels.pipe import Bytes, Message, PipeWriter
from gmijax.channels.pipe_block import PipeBlock
from gmijax.channels.sender import CLOSE_TIMEOUT_S
from gmijax.collectives.device.device_memory import IPC_HANDLE_BYTES, DeviceMemory, NewMemory
from gmijax.collectives.shared_memory import round_up
from gmijax.collectives.waits import wait_until
from gmijax.errors import ConfigError, GmijaxError

_ALIGNMENT = 256
_LEAST_SLOTS = 2

NOTE = np.dtype([("offset", np.int64), ("num_envs", np.int64), ("version", np.int64)])
"""What travels: where a rollout lies, of how many environments it is, and of which policy."""


def slot_offsets(spec: Spec, num_envs: int) -> tuple[list[int], int]:
    """Where the arrays of a rollout lie, bytes from the beginning of its slot, and its size."""
    ends = np.cumsum([0, *(round_up(size, _ALIGNMENT) for size in spec.sizes(num_envs))]).tolist()
    return ends[:-1], ends[-1]


class SlotWriter(PipeWriter):
    """The way to one trainer: notes through a pipe, and slots that are used in turn.

    The first rollout shows how large `num_slots` and `slot_bytes` are.
    """

    def __init__(self, block: PipeBlock, peer: int, capacity_bytes: int) -> None:
        super().__init__(block, peer)
        self.num_slots = self.slot_bytes = 0
        self._capacity_bytes = capacity_bytes

    @property
    def outstanding_messages(self) -> int:
        """Slots in use: of notes that the trainer has not released."""
        return self.messages - self.released_messages

    def try_reserve(self, sizes: Sequence[int]) -> list[Bytes] | None:
        """See `PipeWriter`; None, too, while no slot is free."""
        if self.outstanding_messages >= self.num_slots:
            return None
        return super().try_reserve(sizes)

    def occupancy(self) -> float:
        """How much of the GPU memory is in use, 0 to 1."""
        return self.outstanding_messages * self.slot_bytes / self._capacity_bytes


@dataclass
class ResidentPacker:
    """Leaves rollouts on the device, in `capacity_bytes` for each trainer; a `Packer`."""

    migrator: Migrator[SlotWriter]
    capacity_bytes: int
    new_memory: NewMemory

    def __post_init__(self) -> None:
        self._memory: DeviceMemory | None = None
        self._ipc_handle = b""
        self._head = np.zeros(0, np.uint8)
        self._num_envs = 0
        self._offsets: list[int] = []
        self._slot_bytes = 0

    def try_add(self, piece: Rollouts) -> bool:
        """Copies a rollout into a slot, if one is free; its arrays are jax's.

        Raises:
          ConfigError: too little memory for two rollouts, or one of another size.
          CudaError: memory of the GPU cannot be shared.
        """
        memory = self._prepare(piece)
        opened = self.migrator.try_open([self._head.size, IPC_HANDLE_BYTES, NOTE.itemsize])
        if opened is None:
            return False
        writer, views = opened
        slot = writer.messages % writer.num_slots
        place = self.migrator.writers.index(writer) * writer.num_slots + slot
        offset = place * self._slot_bytes
        for begin, channel in zip(self._offsets, piece.spec.channels, strict=True):
            memory.write(offset + begin, piece.experience[channel.name])  # pyright: ignore[reportArgumentType]
        views[0][:] = self._head
        views[1][:] = np.frombuffer(self._ipc_handle, np.uint8)
        views[2].view(NOTE)[0] = (offset, piece.num_envs, piece.versions[0])
        writer.commit()
        return True

    def flush(self) -> None:
        """Nothing ever waits for more to come."""

    def close(self) -> None:
        """Frees the memory when the trainers have read all, or some time has passed."""
        with contextlib.suppress(GmijaxError):  # A trainer that is gone wants nothing.
            wait_until(self._is_read, self.migrator.why_lost, CLOSE_TIMEOUT_S)
        if self._memory is not None:
            self._memory.close()

    def _is_read(self) -> bool | None:
        return not any(writer.outstanding_messages for writer in self.migrator.writers) or None

    def _prepare(self, piece: Rollouts) -> DeviceMemory:
        """The memory; its slots are made when the first rollout shows how large they are."""
        if self._memory is not None:
            if piece.num_envs != self._num_envs:
                raise ConfigError(
                    f"experience: got {piece.num_envs} environments, the first had "
                    f"{self._num_envs}"
                )
            return self._memory
        self._head, self._num_envs = piece.spec.encode(), piece.num_envs
        self._offsets, self._slot_bytes = slot_offsets(piece.spec, piece.num_envs)
        num_slots = self.capacity_bytes // self._slot_bytes
        if num_slots < _LEAST_SLOTS:
            raise ConfigError(
                f"channel.capacity_mib={self.capacity_bytes >> 20}: must hold {_LEAST_SLOTS} "
                f"rollouts of {self._slot_bytes} bytes"
            )
        memory = self.new_memory()
        self._ipc_handle = memory.create(len(self.migrator.writers) * num_slots * self._slot_bytes)
        self._memory = memory
        for writer in self.migrator.writers:
            writer.num_slots, writer.slot_bytes = num_slots, self._slot_bytes
        return memory


class ResidentDecoder:
    """Reads in place what one agent has left on the device; a `Decode`."""

    def __init__(self, new_memory: NewMemory) -> None:
        self._new_memory = new_memory
        self._memory: DeviceMemory | None = None
        self._views: dict[int, dict[str, jax.Array]] = {}

    def __call__(self, message: Message, agent: int) -> Rollouts:
        """The rollout that a note tells of.

        Raises:
          CudaError: the agent's memory cannot be read here.
        """
        head, ipc_handle, note = message
        spec = Spec.decode(head)
        offset, num_envs, version = note.view(NOTE)[0].tolist()
        if self._memory is None:
            self._memory = self._new_memory()
            self._memory.open(ipc_handle.tobytes())
        if offset not in self._views:
            self._views[offset] = {
                channel.name: self._memory.view(
                    offset + begin, channel.full_shape(num_envs), np.dtype(channel.dtype)
                )
                for begin, channel in zip(
                    slot_offsets(spec, num_envs)[0], spec.channels, strict=True
                )
            }
        arrays: dict[str, Any] = dict(self._views[offset])
        versions, agents = (np.full(num_envs, one, np.int64) for one in (version, agent))
        return Rollouts(spec, arrays, versions, agents)

    def close(self) -> None:
        """Gives the mapping back."""
        self._views.clear()
        if self._memory is not None:
            self._memory.close()
            self._memory = None


class DeviceStack(Stack):
    """A batch that is put together on the device; parts are copied, for their slots get reused."""

    def _begin(self) -> None:
        self._parts: dict[str, list[jax.Array]] = {c.name: [] for c in self.spec.channels}

    def _put(self, name: str, low: int, high: int, array: Any) -> None:
        del low, high  # Parts come in order.
        self._parts[name].append(jnp.copy(array).block_until_ready())

    def _so_far(self) -> dict[str, Any]:
        return {name: jnp.concatenate(parts, axis=1) for name, parts in self._parts.items()}
