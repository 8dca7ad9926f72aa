"""The shared block: its geometry, its descriptor, who may attach."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator

import pytest

from gmijax.collectives.host.shared_block import LANES, LINE, attach, create_exchange
from gmijax.errors import CollectiveError


@pytest.fixture
def exchange_fd() -> Iterator[int]:
    fd = create_exchange()
    yield fd
    os.close(fd)


@pytest.mark.parametrize(("world_size", "num_floats"), [(1, 1), (3, 17), (16, 10_003)])
def test_parts_of_the_block_do_not_overlap_and_begin_at_cache_lines(
    world_size: int, num_floats: int, exchange_fd: int
) -> None:
    first, second = (attach(exchange_fd, 0, world_size, num_floats, lane) for lane in range(LANES))
    parts = [
        first.lines["heartbeats"],
        second.lines["heartbeats"],
        first.gathered,
        second.gathered,
    ]
    parts += [first.slots, first.flags]
    for number, part in enumerate(parts):
        part[...] = number
    for number, part in enumerate(parts):
        assert (part == number).all()
    assert not any(part.ctypes.data % 64 for part in (first.lines, *parts[2:]))
    assert not any(stride % 64 for stride in first.slots.strides[:2])


@pytest.mark.parametrize("page_bytes", [4096, 65536])
def test_what_a_gpu_maps_is_whole_pages_of_this_machine(
    page_bytes: int, exchange_fd: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mmap.PAGESIZE", page_bytes)
    block = attach(exchange_fd, 0, 3, 100)
    assert (block.flags.ctypes.data - block.lines.ctypes.data) % page_bytes == 0
    assert block.flags.nbytes == page_bytes


def test_a_line_is_one_cache_line() -> None:
    assert LINE.itemsize == 64


def test_the_file_is_private_and_not_inherited_by_accident(exchange_fd: int) -> None:
    assert stat.S_IMODE(os.fstat(exchange_fd).st_mode) == 0o600
    assert not os.get_inheritable(exchange_fd)


def test_a_smaller_rank_does_not_shrink_the_file(exchange_fd: int) -> None:
    large = attach(exchange_fd, 0, 2, 100_000)
    size = os.fstat(exchange_fd).st_size
    attach(exchange_fd, 1, 2, 10)
    assert os.fstat(exchange_fd).st_size == size
    assert large.slots[1, 1, -1] == 0.0


def test_one_rank_number_is_given_once(exchange_fd: int) -> None:
    attach(exchange_fd, 1, 2, 10)
    with pytest.raises(CollectiveError, match=f"GMI 1 is taken already by process {os.getpid()}"):
        attach(exchange_fd, 1, 2, 10)


def test_a_descriptor_that_is_no_memory_is_refused() -> None:
    reader, writer = os.pipe()
    try:
        with pytest.raises(CollectiveError, match=f"MiB of shared memory at descriptor {reader}"):
            attach(reader, 0, 1, 10)
    finally:
        os.close(reader)
        os.close(writer)
