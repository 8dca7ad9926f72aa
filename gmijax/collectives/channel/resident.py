"""Experience that stays on the GPU: agents and trainers of one GPU share a block of its memory.

Every agent makes a block with slots for each trainer; a slot holds one rollout, an array a
channel. What travels through the pipe of shared memory is a note of where it lies, with sequence
number and checksum as any message. The trainer reads it in place, and the slot is free again when
it has released the note. So order, back-pressure and the discovery of the dead are the pipe's, and
no experience passes through the host. What lies in the slots has no checksum.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gmijax.collectives.channel.device_slots import NOTE, Slot, slot_of
from gmijax.collectives.channel.ends import CLOSE_TIMEOUT_S
from gmijax.collectives.channel.interface import SenderStats
from gmijax.collectives.channel.memory import MemoryOutlet
from gmijax.collectives.channel.migrator import Migrator
from gmijax.collectives.channel.spec import Spec, spec_of
from gmijax.collectives.device_memory import TICKET_BYTES, DeviceMemory, NewMemory
from gmijax.collectives.pipe import Bytes
from gmijax.collectives.waits import wait_until
from gmijax.errors import ConfigError, GmijaxError

_LEAST_SLOTS = 2


class _Way:
    """The way to one trainer: notes, and slots that are used in turn; an `Outlet`."""

    def __init__(self, notes: MemoryOutlet, capacity_bytes: int) -> None:
        self.peer = notes.peer
        self.max_message_bytes = notes.max_message_bytes
        self.num_slots = self.slot_bytes = 0
        self._notes = notes
        self._capacity_bytes = capacity_bytes

    @property
    def sent_items(self) -> int:
        return self._notes.sent_items

    @property
    def next_slot(self) -> int:
        """Which slot the next note is about."""
        return self._notes.messages % self.num_slots

    def try_reserve(self, sizes: Sequence[int]) -> list[Bytes] | None:
        if self._notes.outstanding_messages >= self.num_slots:
            return None
        return self._notes.try_reserve(sizes)

    def commit(self, *, tag: int = 0, items: int = 1) -> None:
        self._notes.commit(tag=tag, items=items)

    def load_bytes(self) -> int:
        return self._notes.load_bytes()

    def occupancy(self) -> float:
        return self._notes.outstanding_messages * self.slot_bytes / self._capacity_bytes

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        return self._notes.why_lost(operation, step)

    def close(self) -> None:
        self._notes.close()


class ResidentSender:
    """An agent's end; an `ExperienceSender` of arrays that lie on the device.

    Args:
      rank: of this agent.
      notes: the ways to its trainers, all on its GPU.
      gpu_of: GPUs by rank.
      capacity_bytes: GPU memory for each trainer.
      new_memory: how the processes share memory of the GPU.
      leave: called at the end.
    """

    on_device = True

    def __init__(
        self,
        rank: int,
        notes: Sequence[MemoryOutlet],
        gpu_of: Mapping[int, int],
        capacity_bytes: int,
        new_memory: NewMemory,
        leave: Callable[[], None],
    ) -> None:
        self._ways = [_Way(outlet, capacity_bytes) for outlet in notes]
        self._migrator = Migrator(self._ways, gpu_of[rank], gpu_of)
        self._capacity_bytes = capacity_bytes
        self._new_memory = new_memory
        self._leave = leave
        self._memory: DeviceMemory | None = None
        self._ticket = b""
        self._spec: Spec | None = None
        self._num_envs = 0
        self._slot = Slot((), 0)
        self._sent = 0
        self._waited_s = 0.0
        self._is_open = True

    def send(self, experience: Mapping[str, Any], version: int, timeout_s: float) -> bool:
        """See `ExperienceSender`; arrays are jax's, and are copied on the device.

        Raises:
          CudaError: memory of the GPU cannot be shared.
        """
        self._migrator.check()
        self._prepare(experience)
        assert self._spec is not None
        text = self._spec.encode()
        sizes = [len(text), TICKET_BYTES, NOTE.itemsize]
        started_s = time.monotonic()
        opened = wait_until(
            lambda: self._migrator.try_open(sizes), self._migrator.why_lost, timeout_s
        )
        self._waited_s += time.monotonic() - started_s
        if opened is None:
            return False
        way, (head, ticket, note) = opened
        assert isinstance(way, _Way)
        offset = (self._ways.index(way) * way.num_slots + way.next_slot) * self._slot.num_bytes
        assert self._memory is not None
        for begin, channel in zip(self._slot.offsets, self._spec.channels, strict=True):
            self._memory.write(offset + begin, experience[channel.name])
        head[:] = np.frombuffer(text, np.uint8)
        ticket[:] = np.frombuffer(self._ticket, np.uint8)
        note.view(NOTE)[0] = (offset, self._num_envs, version)
        way.commit()
        self._sent += 1
        return True

    @property
    def sent_pieces(self) -> int:
        """Rollouts that trainers have got or will get, of predecessors with this rank too."""
        return self._migrator.sent_items

    def flush(self) -> None:
        """Nothing ever waits for more to come."""

    def stats(self) -> SenderStats:
        """See `ExperienceSender`."""
        return SenderStats(
            pieces=self._sent,
            dropped=0,
            transfers=self._sent,
            num_bytes=self._sent * self._slot.num_bytes,
            waited_s=self._waited_s,
            transfer_bytes=self._slot.num_bytes,
            occupancy=self._migrator.occupancy() if self._is_open else 0.0,
            least_occupancy=self._migrator.least_occupancy() if self._is_open else 0.0,
        )

    def close(self) -> None:
        """See `ExperienceSender`.

        It waits a while for trainers: what they have not read goes with this process.
        """
        if self._is_open:
            self._is_open = False
            self._migrator.close()
            with contextlib.suppress(GmijaxError):  # A trainer that is gone wants nothing.
                wait_until(self._is_read, self._migrator.why_lost, CLOSE_TIMEOUT_S)
            if self._memory is not None:
                self._memory.close()
            self._leave()

    def _is_read(self) -> bool | None:
        return not any(way.occupancy() for way in self._ways) or None

    def _prepare(self, experience: Mapping[str, Any]) -> None:
        """Makes the slots when the first rollout shows how large they are."""
        spec, num_envs = spec_of(experience, ())
        if self._spec is not None:
            if (spec, num_envs) != (self._spec, self._num_envs):
                raise ConfigError(f"experience: got {spec}, the first was {self._spec}")
            return
        self._spec, self._num_envs, self._slot = spec, num_envs, slot_of(spec, num_envs)
        num_slots = self._capacity_bytes // self._slot.num_bytes
        if num_slots < _LEAST_SLOTS:
            raise ConfigError(
                f"channel.capacity_mib={self._capacity_bytes >> 20}: must hold {_LEAST_SLOTS} "
                f"rollouts of {self._slot.num_bytes} bytes"
            )
        self._memory = self._new_memory()
        total = len(self._ways) * num_slots * self._slot.num_bytes
        self._ticket = self._memory.create(total)
        for way in self._ways:
            way.num_slots, way.slot_bytes = num_slots, self._slot.num_bytes
