"""Means and sums of several ranks, each a thread of this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import pytest
from shared_ranks import host_ranks, pipe_blocks

from gmijax.channels.messenger import Messenger
from gmijax.collectives.interface import FloatBuffer
from gmijax.errors import CollectiveError
from gmijax.roles.group import AT_ONCE_BYTES, GroupReducer

RANKS = 3
SMALL = AT_ONCE_BYTES // 4
LARGE = 2 * SMALL

T = TypeVar("T")


@pytest.fixture
def pool() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(RANKS) as made:
        yield made


def on_all(pool: ThreadPoolExecutor, call: Callable[[int], T]) -> list[T]:
    """What `call(rank)` returns on every rank, all at the same time."""
    return [one.result() for one in [pool.submit(call, rank) for rank in range(RANKS)]]


def messengers(timeout_s: float = 20.0) -> list[Messenger]:
    """Of all ranks."""
    return [Messenger(block, timeout_s) for block in pipe_blocks(RANKS)]


def groups(build: Any = None, between: list[Messenger] | None = None) -> list[GroupReducer]:
    """Of all ranks; `build(rank, num_floats)` makes the reducers for large means."""
    return [
        GroupReducer(one, lambda size, rank=rank: build(rank, size))
        for rank, one in enumerate(between or messengers())
    ]


def by_messages(buffers: list[FloatBuffer], count: int) -> Callable[[int], FloatBuffer]:
    """The mean of the first `count` numbers, as small or large data of any group."""
    members = groups()

    def mean(rank: int) -> FloatBuffer:
        members[rank]._num_floats = 1  # Another length is by messages, however large.
        return members[rank].reduce(range(RANKS), buffers[rank][:count], "mean")

    return mean


def test_the_mean_of_three_has_the_same_bits_on_every_way(pool: ThreadPoolExecutor) -> None:
    rng = np.random.default_rng(0)
    buffers = [rng.normal(size=LARGE).astype(np.float32) for _ in range(RANKS)]
    expected = (buffers[0] + buffers[1] + buffers[2]) * np.float32(1 / 3)
    assert (expected != (buffers[0] + buffers[1] + buffers[2]) / np.float32(3)).any()
    exchanges = host_ranks(*[LARGE] * RANKS)
    ways = {
        "small": by_messages(buffers, SMALL),
        "large": by_messages(buffers, LARGE),
        "of all": lambda rank: exchanges[rank].mean(buffers[rank]),
    }
    for name, way in ways.items():
        for found in on_all(pool, way):
            assert found.tobytes() == expected[: found.size].tobytes(), name


@pytest.mark.parametrize("first", [0, 1])
def test_the_error_of_ranks_that_ask_for_different_things_names_both(
    first: int, pool: ThreadPoolExecutor
) -> None:
    """By messages and by a reducer, whoever comes first."""
    exchanges = host_ranks(*[LARGE] * RANKS, timeout_s=1.0)
    between = messengers(timeout_s=10.0)
    members = groups(lambda rank, _: exchanges[rank], between)
    operations = ("mean", "sum", "mean")

    def reduce(rank: int) -> str:
        with pytest.raises(CollectiveError) as caught:
            members[rank].reduce(range(RANKS), np.ones(LARGE, np.float32), operations[rank])
        return str(caught.value)

    early = pool.submit(reduce, first)
    while first == 1 and not between[0].has_message(1, tag=1):
        pass
    while first == 0 and not exchanges[0].barrier.step:
        pass
    others = [pool.submit(reduce, rank) for rank in range(RANKS) if rank != first]
    messages = [one.result() for one in (early, *others)]
    for message in messages:
        assert "the mean of 8192 numbers of float32" in message
        assert "the sum of 8192 numbers of float32" in message
