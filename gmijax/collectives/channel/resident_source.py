"""The trainer's side of experience that stays on the GPU; `resident` is the agent's."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.collectives.channel.batcher import Stack
from gmijax.collectives.channel.compressor import Transfer
from gmijax.collectives.channel.device_slots import NOTE, slot_of
from gmijax.collectives.channel.interface import Inlet
from gmijax.collectives.channel.spec import Spec
from gmijax.collectives.device_memory import DeviceMemory, NewMemory
from gmijax.errors import GmijaxError


class ResidentSource:
    """What one agent has left on the device; a `CountingSource`."""

    def __init__(self, inlet: Inlet, new_memory: NewMemory) -> None:
        self.peer = inlet.peer
        self.transfers = self.num_bytes = self.discarded = 0
        self._inlet = inlet
        self._new_memory = new_memory
        self._memory: DeviceMemory | None = None
        self._ticket = b""
        self._views: dict[int, dict[str, jax.Array]] = {}

    def try_next(self) -> Transfer | None:
        """See `Source`.

        Raises:
          CudaError: the agent's memory cannot be read here.
        """
        message = self._inlet.try_get()
        if message is None:
            return None
        spec = Spec.decode(message.parts[0].tobytes())
        offset, num_envs, version = message.parts[2].view(NOTE)[0].tolist()
        self._open(message.parts[1].tobytes())
        if offset not in self._views:
            self._views[offset] = self._view(spec, num_envs, offset)
        self.transfers += 1
        self.num_bytes += sum(spec.sizes(num_envs))
        versions = np.full(num_envs, version, np.int64)
        arrays: dict[str, Any] = dict(self._views[offset])
        return Transfer(spec, num_envs, versions, arrays)

    def release(self) -> None:
        """See `Source`."""
        self._inlet.release()

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """See `Source`."""
        return self._inlet.why_lost(operation, step)

    def close(self) -> None:
        """Gives the mapping back."""
        self._views.clear()
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    def _open(self, ticket: bytes) -> None:
        if ticket != self._ticket:  # The first of an agent, or of its successor.
            self.close()
            self._memory = self._new_memory()
            self._memory.open(ticket)
            self._ticket = ticket

    def _view(self, spec: Spec, num_envs: int, offset: int) -> dict[str, jax.Array]:
        assert self._memory is not None
        begins = slot_of(spec, num_envs).offsets
        return {
            channel.name: self._memory.view(
                offset + begin, channel.full_shape(num_envs), np.dtype(channel.dtype)
            )
            for begin, channel in zip(begins, spec.channels, strict=True)
        }


class DeviceStack(Stack):
    """A batch that is put together on the device; parts are copied, for their slots get reused."""

    def _begin(self) -> None:
        self._parts: dict[str, list[jax.Array]] = {c.name: [] for c in self.spec.channels}

    def _put(self, name: str, low: int, high: int, array: Any) -> None:
        del low, high  # Parts come in order.
        self._parts[name].append(jnp.copy(array).block_until_ready())

    def _so_far(self) -> dict[str, Any]:
        return {name: jnp.concatenate(parts, axis=1) for name, parts in self._parts.items()}
