"""Experience that stays on the GPU which agents and trainers share (`device_arrays.py`).

What travels through the pipe of shared memory is a note of where a rollout lies, with sequence
number and checksum as any message. The trainer reads it in place.

The parts of a message are the spec, the handle of the agent's block, and the number of
environments, the policy version and the offset of every channel, int64.
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
from gmijax.channels.device_arrays import BufferedArray, ReceivedArrays, SentArrays, region_bytes
from gmijax.channels.experience import Rollouts, Spec
from gmijax.channels.migrator import Migrator
from gmijax.channels.pipe import Bytes, Message, PipeWriter
from gmijax.channels.pipe_block import PipeBlock
from gmijax.channels.sender import CLOSE_TIMEOUT_S
from gmijax.collectives.device.device_memory import IPC_HANDLE_BYTES, NewMemory
from gmijax.collectives.waits import wait_until
from gmijax.errors import ConfigError, GmijaxError

_LEAST_ROLLOUTS = 2


class DeviceWriter(PipeWriter):
    """The way to one trainer: notes through a pipe, and rollouts in this agent's block.

    The first rollout shows how large `rollout_bytes` is.
    """

    def __init__(self, block: PipeBlock, peer: int, sent: SentArrays) -> None:
        super().__init__(block, peer)
        self.rollout_bytes = 0
        self._sent = sent

    def try_reserve(self, sizes: Sequence[int]) -> list[Bytes] | None:
        """See `PipeWriter`; None, too, while the block has no space for a rollout."""
        if not self._sent.has_space(self.peer, self.rollout_bytes, self.released_messages):
            return None
        return super().try_reserve(sizes)

    def occupancy(self) -> float:
        """How much of the GPU memory is in use, 0 to 1."""
        outstanding = self.messages - self.released_messages
        return outstanding * self.rollout_bytes / self._sent.part_bytes


@dataclass
class ResidentPacker:
    """Leaves rollouts on the device; a `MessageEncoder`."""

    migrator: Migrator[DeviceWriter]
    sent: SentArrays

    def __post_init__(self) -> None:
        self._head = np.zeros(0, np.uint8)
        self._num_envs = 0

    def try_add(self, piece: Rollouts) -> bool:
        """Copies a rollout into the block, if there is space; its arrays are jax's.

        Raises:
          ConfigError: too little memory for two rollouts, or one of another size.
          CudaError: memory of the GPU cannot be shared.
        """
        self._check(piece)
        arrays = [piece.experience[channel.name] for channel in piece.spec.channels]
        note_bytes = 8 * (2 + len(arrays))
        opened = self.migrator.try_open([self._head.size, IPC_HANDLE_BYTES, note_bytes])
        if opened is None:
            return False
        writer, views = opened
        placed = self.sent.put(arrays, writer.peer, writer.released_messages)
        assert placed is not None  # `DeviceWriter.try_reserve` has looked.
        offsets = (array.offset for array in placed)
        views[0][:] = self._head
        views[1][:] = np.frombuffer(placed[0].ipc_handle, np.uint8)
        views[2].view(np.int64)[:] = piece.num_envs, piece.versions[0], *offsets
        writer.commit()
        self.sent.mark_sent(writer.peer, writer.messages)
        return True

    def flush(self) -> None:
        """Nothing ever waits for more to come."""

    def close(self) -> None:
        """Frees the memory when the trainers have read all, or some time has passed."""
        with contextlib.suppress(GmijaxError):  # A trainer that is gone wants nothing.
            wait_until(self._is_read, self.migrator.why_lost, CLOSE_TIMEOUT_S)
        self.sent.close()

    def _is_read(self) -> bool | None:
        writers = self.migrator.writers
        return not any(self.sent.holds(w.peer, w.released_messages) for w in writers) or None

    def _check(self, piece: Rollouts) -> None:
        """Takes the size of the first rollout; all others must have the same."""
        if self._num_envs:
            if piece.num_envs != self._num_envs:
                raise ConfigError(
                    f"experience: got {piece.num_envs} environments, the first had "
                    f"{self._num_envs}"
                )
            return
        rollout_bytes = region_bytes(piece.spec.sizes(piece.num_envs))
        if self.sent.part_bytes < _LEAST_ROLLOUTS * rollout_bytes:
            raise ConfigError(
                f"channel.capacity_mib={self.sent.part_bytes >> 20}: must hold {_LEAST_ROLLOUTS} "
                f"rollouts of {rollout_bytes} bytes"
            )
        self._head, self._num_envs = piece.spec.encode(), piece.num_envs
        for writer in self.migrator.writers:
            writer.rollout_bytes = rollout_bytes


class ResidentDecoder:
    """Reads in place what one agent has left on the device; a `Decode`."""

    def __init__(self, new_memory: NewMemory) -> None:
        self._received = ReceivedArrays(new_memory)

    def __call__(self, message: Message, agent: int) -> Rollouts:
        """The rollout that a note describes.

        Raises:
          CudaError: the agent's memory cannot be read here.
        """
        head, ipc_handle, note = message
        spec, block = Spec.decode(head), ipc_handle.tobytes()
        num_envs, version, *offsets = note.view(np.int64).tolist()
        arrays: dict[str, Any] = {
            channel.name: self._received.view(
                BufferedArray(block, offset, channel.full_shape(num_envs), channel.dtype)
            )
            for channel, offset in zip(spec.channels, offsets, strict=True)
        }
        versions, agents = (np.full(num_envs, one, np.int64) for one in (version, agent))
        return Rollouts(spec, arrays, versions, agents)

    def close(self) -> None:
        """Gives the mapping back."""
        self._received.close()


class DeviceStack(Stack):
    """A batch put together on the device; parts are copied, for their memory gets reused."""

    def _begin(self) -> None:
        self._parts: dict[str, list[jax.Array]] = {c.name: [] for c in self.spec.channels}

    def _put(self, name: str, low: int, high: int, array: Any) -> None:
        del low, high  # Parts come in order.
        self._parts[name].append(jnp.copy(array).block_until_ready())

    def _so_far(self) -> dict[str, Any]:
        return {name: jnp.concatenate(parts, axis=1) for name, parts in self._parts.items()}
