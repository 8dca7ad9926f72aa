"""What a message in the ring of a pipe looks like, and how damage to it is found.

| offset | content |
|---|---|
| 0 | `Header`, with the checksum of the parts |
| behind it | CRC-32 of header and sizes |
| 64 | sizes of the parts in bytes, uint64 each |
| next multiple of 64 | the parts, each from a multiple of 64 on, so that arrays are aligned |

A message is contiguous. What is left at the end of the ring and too short is a gap: a header of
its own kind that only says how long it is.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.collectives.shared_memory import round_up

Bytes: TypeAlias = npt.NDArray[np.uint8]

ALIGNMENT = 64
MAGIC = 0x4D494D47  # "GMIM" in memory on a little-endian machine
MESSAGE, GAP = 1, 2

_HEADER = struct.Struct("=IHHQQqQ")
_CRC = struct.Struct("=I")


class Header(NamedTuple):
    """The header of a message or a gap, in the order of the ring."""

    magic: int
    kind: int
    num_parts: int
    sequence: int
    length: int
    tag: int
    checksum: int


class Damaged(Exception):
    """What stands in the ring is no message; the text says what is wrong."""


def message_bytes(sizes: Sequence[int]) -> int:
    """What a message with parts of such sizes (bytes) takes in the ring."""
    return _parts_offset(len(sizes)) + sum(round_up(size, ALIGNMENT) for size in sizes)


def split_parts(ring: Bytes, begin: int, sizes: Sequence[int]) -> list[Bytes]:
    """The parts of the message at `begin` as views."""
    views, at = [], begin + _parts_offset(len(sizes))
    for size in sizes:
        views.append(ring[at : at + size])
        at += round_up(size, ALIGNMENT)
    return views


def seal_gap(ring: Bytes, begin: int, length: int, sequence: int) -> None:
    """Writes the header of a gap of `length` bytes before message `sequence`."""
    _seal(ring, begin, Header(MAGIC, GAP, 0, sequence, length, 0, 0))


def seal_message(
    ring: Bytes, begin: int, sizes: Sequence[int], *, sequence: int, tag: int
) -> None:
    """Writes header and sizes of a message whose parts are in place."""
    length = message_bytes(sizes)
    total = _checksum(ring[begin + _parts_offset(len(sizes)) : begin + length])
    ring[begin + ALIGNMENT : begin + ALIGNMENT + 8 * len(sizes)].view(np.uint64)[:] = sizes
    _seal(ring, begin, Header(MAGIC, MESSAGE, len(sizes), sequence, length, tag, total))


def read_header(ring: Bytes, begin: int, sequence: int) -> Header:
    """The header at `begin`, which must be of message `sequence` or of the gap before it.

    Raises:
      Damaged: it is not.
    """
    header = Header(*_HEADER.unpack_from(ring.data, begin))
    if header.magic != MAGIC or begin + _parts_offset(header.num_parts) > len(ring):
        raise Damaged("the header is wrong")
    if _crc(ring, begin, header.num_parts) != _CRC.unpack_from(ring.data, begin + _HEADER.size)[0]:
        raise Damaged("the checksum of the header is wrong")
    if header.sequence != sequence:
        raise Damaged(f"it is message {header.sequence}")
    return header


def read_parts(ring: Bytes, begin: int, header: Header) -> tuple[Bytes, ...]:
    """Read-only views of the parts of the message at `begin`.

    Raises:
      Damaged: they are not what was written.
    """
    first = begin + _parts_offset(header.num_parts)
    if _checksum(ring[first : begin + header.length]) != header.checksum:
        raise Damaged("the checksum of the parts is wrong")
    sizes_at = begin + ALIGNMENT
    sizes = ring[sizes_at : sizes_at + 8 * header.num_parts].view(np.uint64).tolist()
    parts = split_parts(ring, begin, sizes)
    for part in parts:
        part.flags.writeable = False
    return tuple(parts)


def _parts_offset(num_parts: int) -> int:
    return round_up(ALIGNMENT + 8 * num_parts, ALIGNMENT)


def _seal(ring: Bytes, begin: int, header: Header) -> None:
    _HEADER.pack_into(ring.data, begin, *header)
    _CRC.pack_into(ring.data, begin + _HEADER.size, _crc(ring, begin, header.num_parts))


def _crc(ring: Bytes, begin: int, num_parts: int) -> int:
    own = zlib.crc32(ring.data[begin : begin + _HEADER.size])
    sizes_at = begin + ALIGNMENT
    return zlib.crc32(ring.data[sizes_at : sizes_at + 8 * num_parts], own)


def _checksum(data: Bytes) -> int:
    """Sum of all 64-bit words, modulo 2^64; `data` has a multiple of 64 bytes.

    Finds what another message left behind, whole or in part; not words that changed places. It
    runs at the speed of memory, where a CRC takes ten times as long as the copy itself.
    """
    return int(np.add.reduce(data.view(np.uint64)))
