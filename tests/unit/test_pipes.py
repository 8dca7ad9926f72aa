"""Pipes in shared memory: what goes in comes out, whatever the sizes; limits and damage."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gmijax.channels import pipe
from gmijax.channels.pipe import PipeReader, PipeWriter
from gmijax.channels.pipe_block import (
    END,
    HEAD,
    LINE,
    LINE_BYTES,
    PipeBlock,
    create_pipes,
)
from gmijax.channels.pipe_format import message_bytes
from gmijax.collectives.shared_memory import Fence, process_of, take_line
from gmijax.errors import CollectiveError, CollectiveTimeout, PipeClosed

CAPACITY = 8192


class Ends(NamedTuple):
    """Both ends of the pipe from rank 0 to rank 1, in one process."""

    fd: int
    blocks: tuple[PipeBlock, PipeBlock]
    writer: PipeWriter
    reader: PipeReader


@pytest.fixture
def ends() -> Iterator[Ends]:
    yield from open_ends()


def open_ends() -> Iterator[Ends]:
    fd = create_pipes(2, CAPACITY)
    first, second = (PipeBlock(fd, rank) for rank in (0, 1))
    yield Ends(fd, (first, second), PipeWriter(first, 1), PipeReader(second, 0))
    first.close()
    second.close()
    os.close(fd)


def raw(num_bytes: int) -> npt.NDArray[np.uint8]:
    return np.zeros(num_bytes, np.uint8)


def test_lines_are_cache_lines() -> None:
    assert LINE.itemsize == END.itemsize == LINE_BYTES == 64
    assert HEAD.itemsize <= LINE_BYTES


@given(
    st.lists(st.lists(st.integers(0, 900), max_size=4), max_size=40),
    st.lists(st.booleans(), min_size=80, max_size=80),
)
@example([[]], [True, False, *[True] * 78])
def test_messages_come_out_whole_and_in_order(sizes: list[list[int]], is_put: list[bool]) -> None:
    """Whatever the order of puts and gets; the ring goes round several times."""
    for ends in open_ends():
        waiting: list[list[bytes]] = []
        todo, is_held = iter(sizes), False
        for number, puts in enumerate(is_put):
            wanted = next(todo, None) if puts else None
            if wanted is not None:
                parts = [np.random.default_rng(number).bytes(size) for size in wanted]
                if ends.writer.try_put([np.frombuffer(part, np.uint8) for part in parts]):
                    waiting.append(parts)
            message = None if puts else ends.reader.try_get()
            assert puts or (message is None) == (not waiting)
            if message is not None:
                assert [part.tobytes() for part in message] == waiting.pop(0)
            if not puts:  # What was got is held until the next one is asked for.
                is_held = message is not None
        assert ends.writer.messages - len(waiting) == ends.reader.messages + is_held
        assert ends.writer.released_messages == ends.reader.messages


def test_the_largest_message_fits_wherever_the_ring_stands(ends: Ends) -> None:
    largest = ends.writer.max_message_bytes
    whole = largest - message_bytes([0])
    for number in range(50):
        ends.writer.put([raw(64 * number)], timeout_s=0.0)
        ends.reader.get(timeout_s=0.0)
        ends.reader.release()
        ends.writer.put([np.full(whole, number, np.uint8)], timeout_s=0.0)
        assert (ends.reader.get(timeout_s=0.0)[0] == number).all()
        ends.reader.release()
    with pytest.raises(CollectiveError, match=f"at most {largest}"):
        ends.writer.try_put([raw(whole + 1)])


def test_arrays_of_any_strides_are_written_without_a_copy_of_theirs(ends: Ends) -> None:
    values = np.arange(60, dtype=np.float32).reshape(3, 4, 5)
    ends.writer.put([values[:, 1:3], np.array([True, False])], timeout_s=1.0)
    message = ends.reader.get(timeout_s=1.0)
    received = message[0].view(np.float32).reshape(3, 2, 5)
    np.testing.assert_array_equal(received, values[:, 1:3])
    assert not received.flags.writeable
    assert received.ctypes.data % 64 == 0


def test_a_full_pipe_and_an_empty_one_wait_no_longer_than_the_limit(ends: Ends) -> None:
    with pytest.raises(CollectiveTimeout, match=r"GMI 1: waited 0.01 s in get.* GMIs \[0\]"):
        ends.reader.get(timeout_s=0.01)
    while ends.writer.try_put([raw(1000)]):
        pass
    with pytest.raises(CollectiveTimeout, match=r"GMI 0: waited 0.01 s in put.* GMIs \[1\]"):
        ends.writer.put([raw(1000)], timeout_s=0.01)
    assert ends.blocks[0].outstanding_bytes(1) == ends.writer.outstanding_bytes > 6000


def test_the_end_of_a_process_closes_its_pipes_after_what_is_in_them(ends: Ends) -> None:
    ends.writer.put([raw(4)], timeout_s=1.0)
    ends.blocks[0].close()
    assert ends.reader.get(timeout_s=1.0)[0].size == 4
    with pytest.raises(PipeClosed, match="GMI 0 has closed"):
        ends.reader.get(timeout_s=5.0)


@pytest.mark.parametrize("offset", [0, 8, 16, 24, 32, 40, 64, 128, 1151])
def test_a_damaged_message_is_found(ends: Ends, offset: int) -> None:
    ends.writer.put([np.arange(128.0)], timeout_s=1.0)
    ends.blocks[0].pipe(0, 1).ring[offset] ^= 0x10
    with pytest.raises(CollectiveError, match="message 0 from GMI 0 is damaged"):
        ends.reader.get(timeout_s=1.0)


def descriptors_of(fd: int) -> int:
    """How many descriptors of this process are of the same memory."""
    count = 0
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # Gone by now: the list's own, and what is collected meanwhile.
            count += os.path.sameopenfile(int(name), fd)
    return count


def test_a_rank_that_is_taken_and_other_memory_are_refused(ends: Ends) -> None:
    descriptors = descriptors_of(ends.fd)
    assert descriptors > 0
    for _ in range(3):
        with pytest.raises(CollectiveError, match="GMI 1 is taken already by process"):
            PipeBlock(ends.fd, 1)
    assert descriptors_of(ends.fd) == descriptors
    empty = os.memfd_create("empty", os.MFD_CLOEXEC)
    with pytest.raises(CollectiveError, match="GMI 1: no pipes at descriptor"):
        PipeBlock(empty, 1)
    os.close(empty)


def test_nothing_is_announced_before_the_fence(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That there is one: what it does cannot be seen on x86, which keeps the order anyway."""
    seen: list[int] = []

    class Seen(Fence):
        look: Callable[[], int] | None = None

        def __call__(self) -> None:
            if self.look is not None:
                seen.append(self.look())

    at_writer, at_reader = fences = Seen(), Seen()
    monkeypatch.setattr(pipe, "Fence", partial(next, iter(fences)))
    writer, reader = PipeWriter(ends.blocks[0], 1), PipeReader(ends.blocks[1], 0)
    at_writer.look = lambda: reader.outstanding_bytes
    writer.put([raw(3)], timeout_s=0.0)
    assert seen == [0, 0]  # One before memory is used again, one before it is handed over.
    in_use = reader.outstanding_bytes
    assert in_use > 0
    reader.get(timeout_s=0.0)
    at_reader.look = lambda: writer.outstanding_bytes
    reader.release()
    assert seen == [0, 0, in_use]
    assert writer.released_messages == 1
    assert seen == [0, 0, in_use, 0]
    line: Any = np.zeros((), LINE)
    fence = "gmijax.collectives.shared_memory.fence"
    monkeypatch.setattr(fence, lambda: seen.append(int(line["pid"])))
    take_line(line, 0)
    assert seen[4:] == [0]
    assert process_of(line).is_running()
    assert seen[5:] == [os.getpid()]


def test_unused_pipes_cost_no_memory() -> None:
    fd = create_pipes(16, 2**26)
    block = PipeBlock(fd, 3)
    block.outstanding_bytes(5)
    assert os.fstat(fd).st_blocks * 512 < 2**20
    block.close()
    os.close(fd)
