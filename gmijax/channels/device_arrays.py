"""Arrays that stay on the GPU which sender and receiver share.

A rank makes a block of GPU memory with a part for each peer. Arrays are copied there on the
device, and a message holds their location. What they take is free again when the receiver has
released the message. So order, back-pressure and the discovery of the dead are the pipe's, and
nothing but notes passes through the host. What lies in the block has no checksum.

Experience is read in place (`device_channel.py`). Messages of roles are copied out
(`DeviceBuffers`); where there is no space, and for arrays that are small or of other types, they
go through the host as usual.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import accumulate
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.collectives.device.device_memory import DeviceMemory, NewMemory
from gmijax.collectives.shared_memory import round_up

LEAST_BYTES: Final = 4096
"""Smaller arrays of messages are through the host as soon as through the device."""

PART_BYTES: Final = 32 << 20
"""GPU memory for the arrays of messages on their way to one neighbour."""

_ALIGNMENT = 256
_MAX_VIEWS = 4096


class BufferedArray(NamedTuple):
    """Where an array lies (bytes in the block of `ipc_handle`); sent instead of the array."""

    ipc_handle: bytes
    offset: int
    shape: tuple[int, ...]
    dtype: str


class _Region(NamedTuple):
    """Bytes in use until the receiver has released so many messages; None: not sent yet."""

    begin: int
    end: int
    messages: int | None


def region_bytes(sizes: Iterable[int]) -> int:
    """What arrays of so many bytes take together."""
    return sum(round_up(size, _ALIGNMENT) for size in sizes)


class SentArrays:
    """This rank's block of GPU memory, with `part_bytes` for the arrays on their way to each peer.

    `released` is, in every method, how many of this rank's messages the peer has released.
    """

    def __init__(self, peers: Collection[int], new_memory: NewMemory, part_bytes: int) -> None:
        self.peers = tuple(sorted(peers))
        self.part_bytes = part_bytes
        self._new_memory = new_memory
        self._regions: dict[int, list[_Region]] = {peer: [] for peer in self.peers}
        self._memory: DeviceMemory | None = None
        self._ipc_handle = b""

    def make(self) -> DeviceMemory:
        """The block, which is made when it is first needed.

        Raises:
          CudaError: memory of the GPU cannot be shared.
        """
        if self._memory is None:
            memory = self._new_memory()
            self._ipc_handle = memory.create(len(self.peers) * self.part_bytes)
            self._memory = memory
        return self._memory

    def has_space(self, dst: int, num_bytes: int, released: int) -> bool:
        """Whether there is a region of so many bytes for `dst`."""
        return self._gap(dst, num_bytes, released) is not None

    def put(self, arrays: Sequence[Any], dst: int, released: int) -> list[BufferedArray] | None:
        """Copies arrays to where rank `dst` finds them; None: there is no space for all.

        Raises:
          CudaError: as `make`.
        """
        memory = self.make()
        num_bytes = region_bytes(array.nbytes for array in arrays)
        if (begin := self._gap(dst, num_bytes, released)) is None:
            return None
        self._regions[dst].append(_Region(begin, begin + num_bytes, None))
        self._regions[dst].sort()
        start = self.peers.index(dst) * self.part_bytes + begin
        ends = accumulate((region_bytes([array.nbytes]) for array in arrays), initial=start)
        placed = []
        for array, offset in zip(arrays, ends, strict=False):
            memory.write(offset, array)
            placed.append(BufferedArray(self._ipc_handle, offset, array.shape, array.dtype.name))
        return placed

    def mark_sent(self, dst: int, messages: int) -> None:
        """What was put for `dst` is in use until it has released `messages` in all."""
        if dst in self._regions:
            self._regions[dst] = [
                region._replace(messages=messages) if region.messages is None else region
                for region in self._regions[dst]
            ]

    def holds(self, dst: int, released: int) -> bool:
        """Whether `dst` has yet to get something that was sent."""
        regions = self._regions.get(dst, ())
        return any(r.messages is not None and r.messages > released for r in regions)

    def close(self) -> None:
        """Gives the block back. Idempotent."""
        if self._memory is not None:
            self._memory.close()
        self._memory = None

    def _gap(self, dst: int, num_bytes: int, released: int) -> int | None:
        """The first free region; so the same few are used again and again."""
        used = [r for r in self._regions[dst] if r.messages is None or r.messages > released]
        self._regions[dst] = used
        begin = 0
        for region in used:
            if begin + num_bytes <= region.begin:
                break
            begin = region.end
        return begin if begin + num_bytes <= self.part_bytes else None


class ReceivedArrays:
    """Arrays in blocks of other ranks, which are mapped when they are first needed."""

    def __init__(self, new_memory: NewMemory) -> None:
        self._new_memory = new_memory
        self._blocks: dict[bytes, DeviceMemory] = {}
        self._views: dict[BufferedArray, jax.Array] = {}

    def view(self, buffered: BufferedArray) -> jax.Array:
        """The array in place: the same view comes again with other values.

        Raises:
          CudaError: the sender's memory cannot be read here.
        """
        if buffered not in self._views:
            if len(self._views) >= _MAX_VIEWS:
                self._views.clear()
            block = self._blocks.get(buffered.ipc_handle)
            if block is None:
                block = self._blocks[buffered.ipc_handle] = self._new_memory()
                block.open(buffered.ipc_handle)
            dtype = np.dtype(buffered.dtype)
            self._views[buffered] = block.view(buffered.offset, buffered.shape, dtype)
        return self._views[buffered]

    def close(self) -> None:
        """Gives the mappings back."""
        self._views.clear()
        for block in self._blocks.values():
            block.close()
        self._blocks.clear()


class DeviceBuffers(SentArrays):
    """Arrays in the messages of one rank to its neighbours on the GPU, and theirs to it."""

    def __init__(
        self, neighbours: Collection[int], new_memory: NewMemory, part_bytes: int = PART_BYTES
    ) -> None:
        super().__init__(neighbours, new_memory, part_bytes)
        self._received = ReceivedArrays(new_memory)
        self._is_usable = True

    def try_put(self, array: Any, dst: int, released: int) -> BufferedArray | None:
        """Puts an array where rank `dst` finds it; None: it must travel through the host."""
        if dst not in self.peers or not _fits(array) or not self._is_made():
            return None
        placed = self.put([array], dst, released)
        return None if placed is None else placed[0]

    def get(self, buffered: BufferedArray) -> jax.Array:
        """A copy of an array, which may be overwritten on return; CudaError as `view`."""
        return jnp.copy(self._received.view(buffered)).block_until_ready()

    def close(self) -> None:
        """Gives the block and the mappings back."""
        self._received.close()
        super().close()

    def _is_made(self) -> bool:
        if self._is_usable:
            try:
                self.make()
            # Whatever it is, of CUDA or of jax: there is another way, through the host.
            except Exception:
                self._is_usable = False
        return self._is_usable


def _fits(array: Any) -> bool:
    """Whether it is an array of jax on one device, of a type that every process can map."""
    return (
        isinstance(array, jax.Array)
        and array.nbytes >= LEAST_BYTES
        and array.dtype.kind in "fiub"
        and array.dtype.isbuiltin == 1
        and len(array.devices()) == 1
    )
