"""What a message in the ring of a pipe looks like, and how damage to it is found.

| offset | content |
|---|---|
| 0 | `Header`, 64 bytes with padding |
| 64 | sizes of the parts in bytes, uint64 each |
| next multiple of 64 | the parts, each from a multiple of 64 on, so that arrays are aligned |

A message is contiguous. What is left at the end of the ring and too short is a gap: a header of
its own kind that holds only its length. The sum of all 64-bit words of a message, modulo 2^64,
is 0, and so is that of a gap's header. That detects what another message left behind, whole or in
part; not words that were swapped. It runs at the speed of memory, where a CRC takes ten times as
long as the copy itself.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.collectives.shared_memory import round_up

Bytes: TypeAlias = npt.NDArray[np.uint8]

ALIGNMENT = 64
MESSAGE, GAP = 0x4D494D47, 0x47494D47  # "GMIM" and "GMIG" in memory on a little-endian machine

_HEADER = struct.Struct("=5Q")
_CHECKSUM = 4  # Index in the header.


class Header(NamedTuple):
    """The header of a message or a gap, in the order of the ring."""

    kind: int
    num_parts: int
    sequence: int
    length: int
    checksum: int = 0


class Damaged(Exception):
    """The content of the ring is no message; the text is what is wrong."""


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
    _seal(ring, begin, Header(GAP, 0, sequence, length), ALIGNMENT)


def seal_message(ring: Bytes, begin: int, sizes: Sequence[int], sequence: int) -> None:
    """Writes header and sizes of a message whose parts are written."""
    length = message_bytes(sizes)
    ring[begin + ALIGNMENT : begin + ALIGNMENT + 8 * len(sizes)].view(np.uint64)[:] = sizes
    _seal(ring, begin, Header(MESSAGE, len(sizes), sequence, length), length)


def read_header(ring: Bytes, begin: int, sequence: int) -> Header:
    """The header at `begin`, which must be of message `sequence` or of the gap before it.

    Raises:
      Damaged: it is not, or the message is not what was written.
    """
    header = Header(*_HEADER.unpack_from(ring.data, begin))
    least = _parts_offset(min(header.num_parts, len(ring)))
    fits = least <= header.length <= len(ring) - begin and header.length % ALIGNMENT == 0
    if header.kind not in (MESSAGE, GAP) or not fits:
        raise Damaged("the header is wrong")
    if _sum(ring, begin, header.length if header.kind == MESSAGE else ALIGNMENT):
        raise Damaged("the checksum is wrong")
    if header.sequence != sequence:
        raise Damaged(f"it is message {header.sequence}")
    return header


def read_parts(ring: Bytes, begin: int, header: Header) -> tuple[Bytes, ...]:
    """Read-only views of the parts of the message at `begin`."""
    sizes_at = begin + ALIGNMENT
    sizes = ring[sizes_at : sizes_at + 8 * header.num_parts].view(np.uint64).tolist()
    parts = split_parts(ring, begin, sizes)
    for part in parts:
        part.flags.writeable = False
    return tuple(parts)


def _parts_offset(num_parts: int) -> int:
    return round_up(ALIGNMENT + 8 * num_parts, ALIGNMENT)


def _seal(ring: Bytes, begin: int, header: Header, num_bytes: int) -> None:
    """Writes the header, with what makes the sum of so many bytes 0."""
    ring[begin : begin + ALIGNMENT] = 0
    _HEADER.pack_into(ring.data, begin, *header)
    words = ring[begin : begin + ALIGNMENT].view(np.uint64)
    words[_CHECKSUM] = -_sum(ring, begin, num_bytes) % 2**64


def _sum(ring: Bytes, begin: int, num_bytes: int) -> int:
    return int(np.add.reduce(ring[begin : begin + num_bytes].view(np.uint64)))
