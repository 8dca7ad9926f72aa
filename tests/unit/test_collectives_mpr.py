"""MPR without processes: ranks as threads, each with a reducer of its own."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.memory import create_exchange
from gmijax.collectives.mpr import MprReducer
from gmijax.errors import CollectiveError, CollectiveTimeout


@pytest.fixture
def alone() -> Iterator[MprReducer]:
    (reducer,) = make_reducers(1, 10)
    yield reducer
    reducer.close()


def make_reducers(
    world_size: int, num_floats: int, timeout_s: float = 10.0
) -> Sequence[MprReducer]:
    fd = create_exchange()
    reducers = [
        MprReducer(
            HostExchange(
                *(fd, rank, world_size, num_floats),
                timeout_s=timeout_s,
                rendezvous_timeout_s=timeout_s,
            ),
            num_floats,
        )
        for rank in range(world_size)
    ]
    os.close(fd)
    return reducers


def on_all_ranks(
    reducers: Sequence[MprReducer], call: Callable[[MprReducer], FloatBuffer]
) -> list[FloatBuffer]:
    with ThreadPoolExecutor(len(reducers)) as pool:
        return list(pool.map(call, reducers))


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
    reducers = make_reducers(world_size, num_floats)
    for mean in on_all_ranks(reducers, lambda reducer: reducer.mean(buffers[reducer.rank])):
        np.testing.assert_array_equal(mean, expected)


def test_values_that_are_not_finite_stay_so_without_a_warning() -> None:
    huge = np.finfo(np.float32).max
    buffers = np.array([[np.nan, np.inf, np.inf, huge], [0.0, 0.0, -np.inf, huge]], np.float32)
    reducers = make_reducers(2, 4)
    for mean in on_all_ranks(reducers, lambda reducer: reducer.mean(buffers[reducer.rank])):
        np.testing.assert_array_equal(mean, [np.nan, np.inf, np.nan, np.inf])


def test_a_result_may_be_handed_in_again() -> None:
    def mean_of_mean(reducer: MprReducer) -> FloatBuffer:
        first = reducer.mean(np.full(100, reducer.rank, np.float32))
        return reducer.mean(first)

    for mean in on_all_ranks(make_reducers(2, 100), mean_of_mean):
        np.testing.assert_array_equal(mean, np.full(100, 0.5))


def test_a_gathered_result_belongs_to_the_caller(alone: MprReducer) -> None:
    gathered = alone.all_gather(np.ones(3, np.float32))
    for value in (5.0, 6.0):
        alone.all_gather(np.full(3, value, np.float32))
    gathered += 1.0
    np.testing.assert_array_equal(gathered, np.full((1, 3), 2.0))


def test_a_second_thread_is_refused(alone: MprReducer) -> None:
    alone.mean(np.zeros(10, np.float32))
    caught: list[Exception] = []

    def call() -> None:
        try:
            alone.mean(np.zeros(10, np.float32))
        except CollectiveError as error:
            caught.append(error)

    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    assert [str(error) for error in caught] == ["rank 0: mean called from a second thread"]


def test_no_call_follows_a_call_that_failed() -> None:
    reducer = make_reducers(2, 10, timeout_s=0.05)[0]
    with pytest.raises(CollectiveTimeout, match=r"0.05 s in mean, step 1, for ranks \[1\]"):
        reducer.mean(np.zeros(10, np.float32))
    with pytest.raises(CollectiveError, match="after a call that did not finish"):
        reducer.all_gather(np.zeros(1, np.float32))


def test_a_refused_buffer_does_not_spoil_the_exchange(alone: MprReducer) -> None:
    with pytest.raises(CollectiveError, match="expected 10"):
        alone.mean(np.zeros(9, np.float32))
    np.testing.assert_array_equal(alone.mean(np.ones(10, np.float32)), np.ones(10))


def test_closing_twice_is_fine_calling_after_it_is_not(alone: MprReducer) -> None:
    mean = alone.mean(np.ones(10, np.float32))
    alone.close()
    alone.close()
    assert mean.sum() == 10.0  # a result in use keeps its memory
    with pytest.raises(CollectiveError, match="mean after close"):
        alone.mean(np.ones(10, np.float32))
