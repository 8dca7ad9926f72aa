"""Arrays of messages that stay on the GPU which sender and receiver share.

Every rank makes a block of GPU memory with a part for each neighbour. An array of jax is copied
there on the device, its message says where it lies, and the receiver copies it out before it
releases the message, which tells the sender that the place is free again. Where there is no
place, and for arrays that are small or of other types, messages travel through the host as ever.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.collectives.device.device_memory import DeviceMemory, NewMemory
from gmijax.collectives.shared_memory import round_up

LEAST_BYTES: Final = 4096
"""Smaller arrays are through the host as soon as through the device."""

PART_BYTES: Final = 32 << 20
"""GPU memory for the arrays on their way to one neighbour."""

_ALIGNMENT = 256
_MAX_VIEWS = 256


class BufferedArray(NamedTuple):
    """Where an array lies (bytes in the block of `ipc_handle`); it travels in its place."""

    ipc_handle: bytes
    offset: int
    shape: tuple[int, ...]
    dtype: str


class _Held(NamedTuple):
    """A place in use until the receiver has released so many frames; None: not sent yet."""

    begin: int
    end: int
    frames: int | None


class DeviceBuffers:
    """One rank's arrays to its neighbours on the GPU (`peers`), and theirs to it."""

    def __init__(
        self,
        neighbours: Collection[int],
        new_memory: NewMemory,
        part_bytes: int = PART_BYTES,
    ) -> None:
        self.peers = tuple(sorted(neighbours))
        self._parts = {peer: place * part_bytes for place, peer in enumerate(self.peers)}
        self._part_bytes = part_bytes
        self._new_memory = new_memory
        self._held: dict[int, list[_Held]] = {peer: [] for peer in self._parts}
        self._own: DeviceMemory | None = None
        self._ipc_handle = b""
        self._is_usable = True
        self._theirs: dict[bytes, DeviceMemory] = {}
        self._views: dict[BufferedArray, jax.Array] = {}

    def put(self, array: Any, dst: int, released_frames: int) -> BufferedArray | None:
        """Puts an array where rank `dst` finds it; None: it must travel through the host.

        `released_frames`: how many frames of this rank's messages `dst` has released so far.
        """
        if dst not in self._parts or not _fits(array) or not self._is_made():
            return None
        held = [
            one for one in self._held[dst] if one.frames is None or one.frames > released_frames
        ]
        self._held[dst] = held
        begin = _gap(held, array.nbytes, self._part_bytes)
        if begin is None:
            return None
        held.append(_Held(begin, begin + array.nbytes, None))
        held.sort()
        offset = self._parts[dst] + begin
        assert self._own is not None
        self._own.write(offset, array)
        return BufferedArray(self._ipc_handle, offset, array.shape, array.dtype.name)

    def mark_sent(self, dst: int, frames: int) -> None:
        """What was put for `dst` is in use until it has released `frames` frames in all."""
        if dst in self._held:
            self._held[dst] = [
                one._replace(frames=frames) if one.frames is None else one
                for one in self._held[dst]
            ]

    def holds(self, dst: int, released_frames: int) -> bool:
        """Whether `dst` has yet to get something that was sent; see `put`."""
        held = self._held.get(dst, ())
        return any(one.frames is not None and one.frames > released_frames for one in held)

    def get(self, buffered: BufferedArray) -> jax.Array:
        """A copy of an array; on return its place may be used again.

        Raises:
          CudaError: the sender's memory cannot be read here.
        """
        if buffered not in self._views:
            if len(self._views) >= _MAX_VIEWS:
                self._views.clear()
            memory = self._theirs.get(buffered.ipc_handle)
            if memory is None:
                memory = self._theirs[buffered.ipc_handle] = self._new_memory()
                memory.open(buffered.ipc_handle)
            dtype = np.dtype(buffered.dtype)
            self._views[buffered] = memory.view(buffered.offset, buffered.shape, dtype)
        return jnp.copy(self._views[buffered]).block_until_ready()

    def _is_made(self) -> bool:
        """Whether there is a block; it is made when it is first wanted."""
        if self._own is None and self._is_usable:
            try:
                self._own = self._new_memory()
                self._ipc_handle = self._own.create(len(self._parts) * self._part_bytes)
            # Whatever it is, of CUDA or of jax: there is another way, through the host.
            except Exception:
                self._own, self._is_usable = None, False
        return self._own is not None


def _fits(array: Any) -> bool:
    """Whether it is an array of jax on one device, of a type that every process can map."""
    return (
        isinstance(array, jax.Array)
        and array.nbytes >= LEAST_BYTES
        and array.dtype.kind in "fiub"
        and array.dtype.isbuiltin == 1
        and len(array.devices()) == 1
    )


def _gap(held: Collection[_Held], num_bytes: int, capacity: int) -> int | None:
    """The first free place for `num_bytes`; the same few places are used again and again."""
    begin = 0
    for one in held:
        if begin + num_bytes <= one.begin:
            break
        begin = round_up(one.end, _ALIGNMENT)
    return begin if begin + num_bytes <= capacity else None
