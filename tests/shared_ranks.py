"""All ranks of a job in this process: their ends of its shared memory."""

from __future__ import annotations

import os
from collections.abc import Sequence

from gmijax.channels.messenger import MIN_CAPACITY_BYTES
from gmijax.channels.pipe_block import PipeBlock, create_pipes
from gmijax.collectives.host.shared_block import create_exchange
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup


def host_ranks(
    *num_floats: int,
    timeout_s: float = 20.0,
    start_s: float | None = None,
    ids: Sequence[int] | None = None,
) -> list[SharedMemoryGroup]:
    """A rank for each of `num_floats`, the length of its largest buffer."""
    fd = create_exchange()
    ranks = [
        SharedMemoryGroup(
            *(fd, rank, len(num_floats), size),
            timeout_s=timeout_s,
            rendezvous_timeout_s=start_s or timeout_s,
            ids=ids,
        )
        for rank, size in enumerate(num_floats)
    ]
    os.close(fd)
    return ranks


def pipe_blocks(world_size: int, capacity_bytes: int = MIN_CAPACITY_BYTES) -> list[PipeBlock]:
    """The block of pipes as every rank sees it."""
    fd = create_pipes(world_size, capacity_bytes)
    blocks = [PipeBlock(fd, rank) for rank in range(world_size)]
    os.close(fd)
    return blocks
