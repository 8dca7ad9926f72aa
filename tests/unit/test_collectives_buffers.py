"""Chunks of a buffer, and checks of what callers hand in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmijax.collectives.buffers import chunk_bounds, require_gather_input, require_mean_input
from gmijax.errors import CollectiveError

WORLD_SIZES = st.integers(1, 64)
LENGTHS = st.integers(1, 5_000_000)


@given(LENGTHS, WORLD_SIZES)
def test_chunks_cover_the_buffer_in_order_without_overlap(
    num_floats: int, world_size: int
) -> None:
    bounds = [chunk_bounds(num_floats, world_size, rank) for rank in range(world_size)]
    ends = [0, *(high for _, high in bounds)]
    assert [low for low, _ in bounds] == ends[:-1]
    assert ends == sorted(ends)
    assert ends[-1] == num_floats


@given(LENGTHS, WORLD_SIZES)
def test_chunks_begin_at_cache_lines_and_differ_by_at_most_one_line(
    num_floats: int, world_size: int
) -> None:
    bounds = [chunk_bounds(num_floats, world_size, rank) for rank in range(world_size)]
    assert all(low % 16 == 0 for low, high in bounds if low < high)
    lines = [-(-(high - low) // 16) for low, high in bounds]
    assert max(lines) - min(lines) <= 1


def test_chunks_of_a_small_buffer_by_hand() -> None:
    # 40 floats are 3 lines (16, 16, 8); 4 ranks get 0, 1, 1, 1 of them.
    assert [chunk_bounds(40, 4, rank) for rank in range(4)] == [
        (0, 0),
        (0, 16),
        (16, 32),
        (32, 40),
    ]


@pytest.mark.parametrize(
    ("buffer", "text"),
    [
        (np.zeros(9, np.float32), "mean: got 9 floats, expected 10"),
        (np.zeros(10, np.float64), r"mean: got float64 of shape \[10\]"),
        (np.zeros((2, 5), np.float32), r"mean: got float32 of shape \[2, 5\]"),
    ],
)
def test_a_wrong_buffer_is_refused_with_what_it_is(buffer: np.ndarray, text: str) -> None:
    with pytest.raises(CollectiveError, match=text):
        require_mean_input(buffer, 10)


def test_more_than_64_kib_a_rank_cannot_be_gathered() -> None:
    require_gather_input(np.zeros(16384, np.float32))
    with pytest.raises(CollectiveError, match="all_gather: got 16385 floats, at most 16384"):
        require_gather_input(np.zeros(16385, np.float32))
