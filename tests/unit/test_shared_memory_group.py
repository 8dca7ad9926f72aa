"""Sums, broadcasts and gathers through the shared block: ranks as threads of one process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shared_ranks import host_ranks

from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup, chunk
from gmijax.collectives.interface import FloatBuffer
from gmijax.errors import CollectiveError, CollectiveTimeout, PeerLost

LATE_S = 0.5


def on_all_ranks(
    ranks: Sequence[SharedMemoryGroup], call: Callable[[SharedMemoryGroup], FloatBuffer]
) -> list[FloatBuffer]:
    with ThreadPoolExecutor(len(ranks)) as pool:
        return list(pool.map(call, ranks))


@pytest.fixture
def alone() -> Iterator[SharedMemoryGroup]:
    (rank,) = host_ranks(10)
    yield rank
    rank.close()


@given(st.integers(1, 5_000_000), st.integers(1, 64))
def test_chunks_cover_the_buffer_and_begin_at_cache_lines(
    num_floats: int, world_size: int
) -> None:
    chunks = [chunk(num_floats, rank, world_size) for rank in range(world_size)]
    ends = [0, *(part.stop for part in chunks)]
    assert [part.start for part in chunks] == ends[:-1]
    assert ends == sorted(ends)
    assert ends[-1] == num_floats
    assert all(part.start % 16 == 0 for part in chunks if part.start < part.stop)
    lines = [-(-(part.stop - part.start) // 16) for part in chunks]
    assert max(lines) - min(lines) <= 1


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 5), st.integers(1, 70_000), st.integers(0, 2**32 - 1))
def test_the_mean_is_the_sum_in_order_of_rank_times_one_over_k(
    world_size: int, num_floats: int, seed: int
) -> None:
    buffers = np.random.default_rng(seed).normal(size=(world_size, num_floats)).astype(np.float32)
    expected = buffers[0].copy()
    for buffer in buffers[1:]:
        expected += buffer
    expected *= np.float32(1.0 / world_size)
    ranks = host_ranks(*[num_floats] * world_size)
    for mean in on_all_ranks(ranks, lambda rank: rank.mean(buffers[rank.rank])):
        np.testing.assert_array_equal(mean, expected)


def test_groups_sum_by_themselves_and_ranks_in_none_keep_what_they_have() -> None:
    groups = ((1, 0), (3, 4))

    def call(rank: SharedMemoryGroup) -> FloatBuffer:
        own, found = np.full(100, 2.0**rank.rank, np.float32), np.empty((3, 100), np.float32)
        for row in found[:2]:  # Twice: slots take turns.
            rank.all_reduce(own, row, groups)
        rank.broadcast(own, found[2], groups)
        return found

    found = on_all_ranks(host_ranks(*[100] * 5), call)
    for rank, (total, first) in enumerate([(3, 2), (3, 2), (4, 4), (24, 8), (24, 8)]):
        np.testing.assert_array_equal(found[rank], np.repeat([[total], [total], [first]], 100, 1))


def test_values_that_are_not_finite_stay_so_without_a_warning() -> None:
    huge = np.finfo(np.float32).max
    buffers = np.array([[np.nan, np.inf, np.inf, huge], [0.0, 0.0, -np.inf, huge]], np.float32)
    for mean in on_all_ranks(host_ranks(4, 4), lambda rank: rank.mean(buffers[rank.rank])):
        np.testing.assert_array_equal(mean, [np.nan, np.inf, np.nan, np.inf])


def test_a_gathered_result_belongs_to_the_caller(alone: SharedMemoryGroup) -> None:
    gathered = alone.all_gather(np.ones(3, np.float32))
    for value in (5.0, 6.0):
        alone.all_gather(np.full(3, value, np.float32))
    gathered += 1.0
    np.testing.assert_array_equal(gathered, np.full((1, 3), 2.0))


def errors_of(ranks: Sequence[SharedMemoryGroup], *sizes: int) -> list[str]:
    """The errors of ranks that take means of different sizes."""

    def mean(rank: SharedMemoryGroup, size: int) -> str:
        with pytest.raises(CollectiveError) as caught:
            rank.mean(np.zeros(size, np.float32))
        return str(caught.value)

    with ThreadPoolExecutor(len(ranks)) as pool:
        return list(pool.map(mean, ranks, sizes))


def test_ranks_with_different_lengths_name_both() -> None:
    fit = "do not fit together: num_floats is"
    assert errors_of(host_ranks(5000, 200_000), 10, 10) == [
        f"GMI 0 and GMI 1 {fit} 5000 for GMI 0, and 200000 for GMI 1",
        f"GMI 1 and GMI 0 {fit} 200000 for GMI 1, and 5000 for GMI 0",
    ]


def test_ranks_are_named_by_the_ids_of_their_gmis() -> None:
    assert errors_of(host_ranks(10, 10, ids=(4, 6)), 8, 9) == [
        "step 1: GMI 4 calls sum of 8 floats, GMI 6 calls sum of 9 floats",
        "step 1: GMI 6 calls sum of 9 floats, GMI 4 calls sum of 8 floats",
    ]
    for message in errors_of(host_ranks(10, 20, ids=(4, 6)), 8, 8):
        assert "GMI 4" in message
        assert "GMI 6" in message


def test_a_rank_that_has_closed_is_lost_to_those_who_still_call() -> None:
    first, second = host_ranks(10, 10)
    second.close()
    with pytest.raises(PeerLost, match="GMI 1 is gone during sum, step 1"):
        first.mean(np.zeros(10, np.float32))


def test_no_call_follows_a_call_that_failed() -> None:
    rank = host_ranks(10, 10, timeout_s=0.05)[0]
    with pytest.raises(CollectiveTimeout, match=r"0.05 s in sum, step 1, for GMIs \[1\]"):
        rank.mean(np.zeros(10, np.float32))
    with pytest.raises(CollectiveError, match="after a call that did not finish"):
        rank.all_gather(np.zeros(1, np.float32))


def test_more_than_64_kib_a_rank_cannot_be_gathered(alone: SharedMemoryGroup) -> None:
    alone.all_gather(np.zeros(16384, np.float32))
    with pytest.raises(CollectiveError, match=r"all_gather of float32 \[16385\]"):
        alone.all_gather(np.zeros(16385, np.float32))


def test_closing_twice_is_fine_calling_after_it_is_not(alone: SharedMemoryGroup) -> None:
    alone.close()
    alone.close()
    with pytest.raises(CollectiveError, match="sum after close"):
        alone.mean(np.ones(10, np.float32))


def test_the_call_after_an_introduction_is_the_first_and_may_take_longer() -> None:
    ranks = host_ranks(4, 4, timeout_s=LATE_S / 4, start_s=20 * LATE_S)

    def gather_late() -> None:
        ranks[1].bootstrap_all_gather(np.ones(3, np.float32))
        time.sleep(LATE_S)
        ranks[1].all_gather(np.ones(1, np.float32))

    late = threading.Thread(target=gather_late)
    late.start()
    np.testing.assert_array_equal(
        ranks[0].bootstrap_all_gather(np.zeros(3, np.float32)).sum(1), [0, 3]
    )
    assert ranks[0].all_gather(np.zeros(1, np.float32)).shape == (2, 1)
    late.join()
    with pytest.raises(CollectiveTimeout, match="step 3"):
        ranks[0].all_gather(np.zeros(1, np.float32))
