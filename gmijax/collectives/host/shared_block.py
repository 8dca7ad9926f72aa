"""The block of shared memory through which the GMIs of one host exchange numbers.

The controller makes an anonymous file (`create_exchange`); its GMIs inherit the descriptor and
map the file (`attach`). The file has no name, so nothing is left behind whichever process is
killed, and it does not count against the size of /dev/shm. The reasons, and the guarantees about
memory order that the protocol needs, are in `docs/decisions/shared-memory-exchange.md`.

This file is the only one that knows the wire format (K ranks, P floats, native byte order):

| offset | content |
|---|---|
| 0 | [2, K] lines of 64 bytes, `LINE`, by lane, each written by its own rank only |
| 128 K | [2, 2, K, MAX_GATHER_FLOATS] float32, values to gather, by lane and parity of the step |
| next page | [2, K, P] float32, two slots a rank, rows padded to whole cache lines |
| next page | K lines of 64 bytes, uint32: `SharedBlock.flags` |
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.collectives.shared_memory import (
    create_file,
    map_file,
    round_up,
    take_line,
    whole_pages,
)

MAX_GATHER_FLOATS = 16384  # 64 KiB a rank
FLOATS_PER_LINE = 16
LANES = 2
"""Each has barriers of its own: from outside of programs, and from within."""

LINE = np.dtype(
    [
        ("pid", np.uint64),  # 0 once the rank has closed its communicator
        ("start_ticks", np.uint64),
        ("num_floats", np.uint64),
        ("call", np.uint64, (2,)),  # what the rank is calling, by parity of the step
        ("sequence", np.uint64),  # 0: not attached; 1: attached; then one up per arrival
        ("heartbeats", np.uint64),  # goes up while the rank waits for others
        ("suspect", np.uint64),  # of the first lane alone, see `SharedBlock`
    ]
)
"""What one rank publishes for the others; exactly a cache line, so that ranks share none."""


class SharedBlock(NamedTuple):
    """The mapped block as arrays; the mapping lives as long as one of them does.

    Attributes:
      rank: the one that has this view.
      lines: [K] of `LINE`, of one lane.
      suspect: [K] uint64, 1 + the rank for which each has given up, in any lane; 0: it has not.
      gathered: [2, K, MAX_GATHER_FLOATS] float32, of the same.
      slots: [2, K, P] float32, used in turn.
      flags: [whole pages, FLOATS_PER_LINE] uint32, of which [rank, 0] counts how often the device
        of a rank has written its slots; 1 is set once the rank is done with slots in device
        memory, and 2 to 3 are the exchanges it has reached (`device_transport.DesyncDetector`).
      ids: of the ranks' GMIs in the job, for messages about lost peers: not all GMIs need have a
        rank, and with several nodes each has a block.
    """

    rank: int
    lines: npt.NDArray[np.void]
    suspect: npt.NDArray[np.uint64]
    gathered: npt.NDArray[np.float32]
    slots: npt.NDArray[np.float32]
    flags: npt.NDArray[np.uint32]
    ids: tuple[int, ...]


def create_exchange() -> int:
    """Makes an empty block and returns its descriptor, for the controller.

    Pass the descriptor to every GMI (`ENV_EXCHANGE_FD` names it there), then close it.
    """
    return create_file("exchange")


def attach(
    fd: int,
    rank: int,
    world_size: int,
    num_floats: int,
    lane: int = 0,
    ids: Sequence[int] | None = None,
) -> SharedBlock:
    """Maps the block and makes this process known as `rank`.

    The block gets its size here, from the first rank to attach; the caller keeps `fd` and may
    close it at once. Ranks that attach with other numbers are detected in their first call. For
    the arguments see `SharedMemoryGroup`.

    Raises:
      CollectiveError: no memory, not such a descriptor, or the rank is taken.
    """
    row_floats = round_up(num_floats, FLOATS_PER_LINE)
    gathered_at = LANES * world_size * LINE.itemsize
    num_gathered = LANES * 2 * world_size * MAX_GATHER_FLOATS
    # Whole pages, because a GPU maps pages.
    slots_at = whole_pages(gathered_at + 4 * num_gathered)
    flags_at = whole_pages(slots_at + 4 * 2 * world_size * row_floats)
    size = flags_at + whole_pages(world_size * LINE.itemsize)
    gmis = tuple(range(world_size) if ids is None else ids)
    mapping = map_file(fd, size, f"GMI {gmis[rank]}")
    lines_of = np.frombuffer(mapping, LINE, LANES * world_size).reshape(LANES, -1)
    lines = lines_of[lane]
    take_line(lines[rank], gmis[rank])
    lines["num_floats"][rank] = num_floats
    gathered = np.frombuffer(mapping, np.float32, num_gathered, gathered_at)
    slots = np.frombuffer(mapping, np.float32, 2 * world_size * row_floats, slots_at)
    return SharedBlock(
        rank=rank,
        lines=lines,
        suspect=lines_of[0]["suspect"],
        gathered=gathered.reshape(LANES, 2, world_size, MAX_GATHER_FLOATS)[lane],
        slots=slots.reshape(2, world_size, row_floats)[:, :, :num_floats],
        flags=np.frombuffer(mapping, np.uint32, -1, flags_at).reshape(-1, FLOATS_PER_LINE),
        ids=gmis,
    )
