"""Slots in device memory of one rank, with memory that is not a GPU's."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
import pytest
from fake_device_memory import FakeDeviceMemory, WithoutQueue, one_shot_of_one
from hypothesis import given
from hypothesis import strategies as st

from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import Peers
from gmijax.collectives.memory import create_exchange
from gmijax.collectives.one_shot import OneShotReducer
from gmijax.collectives.shared_slots import SharedSlots
from gmijax.collectives.stream_exchange import Order
from gmijax.errors import CollectiveError, DeviceMemoryUnavailable
from gmijax.partition.layout import Layout
from gmijax.types import Array

SIZE = 5

Pair: TypeAlias = tuple[list[HostExchange], list[SharedSlots], list[str]]


@pytest.fixture
def host() -> Iterator[HostExchange]:
    fd = create_exchange()
    exchange = HostExchange(fd, 0, 1, SIZE, timeout_s=1.0, rendezvous_timeout_s=1.0)
    os.close(fd)
    yield exchange
    exchange.close()


class Counted(FakeDeviceMemory):
    """Counts those that are open; the second one cannot be had."""

    num_open = 0

    def __init__(self) -> None:
        if Counted.num_open:
            raise RuntimeError("no more memory")
        super().__init__()
        Counted.num_open += 1

    def close(self) -> None:
        super().close()
        Counted.num_open -= 1


def test_what_was_made_before_a_failure_is_closed(host: HostExchange) -> None:
    said = "wish: rank 0: no more memory"
    with pytest.raises(DeviceMemoryUnavailable, match=said):
        SharedSlots(host, SIZE, [0], [0, 0], 1.0, Counted, "wish")
    assert Counted.num_open == 0


@pytest.fixture
def pair() -> Iterator[Pair]:
    """Two ranks with slots in the memory of the first; what was closed is noted."""
    closed: list[str] = []

    class Noted(FakeDeviceMemory):
        def close(self) -> None:
            super().close()
            closed.append("closed")

    fd = create_exchange()
    hosts = [
        HostExchange(fd, rank, 2, SIZE, timeout_s=20.0, rendezvous_timeout_s=20.0)
        for rank in (0, 1)
    ]
    os.close(fd)
    with ThreadPoolExecutor(2) as pool:
        making = [
            pool.submit(SharedSlots, host, SIZE, [0, 1], [0], 1.0, Noted, "wish") for host in hosts
        ]
        slots = [one.result() for one in making]
    yield hosts, slots, closed
    for one in reversed(slots):
        one.close()
    for host in hosts:
        host.close()


def test_memory_stays_until_all_are_through_with_it(pair: Pair) -> None:
    hosts, (owner, other), closed = pair
    with ThreadPoolExecutor(1) as pool:
        closing = pool.submit(owner.close)
        while not (hosts[0].flags[0, 1] or closed):
            pass  # Until the owner has come to it.
        closed.append("read")
        other.close()
        closing.result()
    assert closed == ["read", "closed", "closed"]


@pytest.mark.timeout(20)
def test_who_is_gone_is_not_waited_for(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gmijax.collectives.shared_slots.CLOSE_S", 1e9)
    hosts, (owner, _), closed = pair
    hosts[1]._turns.leave()
    owner.close()
    assert closed == ["closed"]


@pytest.mark.timeout(20)
def test_who_failed_does_not_wait_to_close(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gmijax.collectives.shared_slots.CLOSE_S", 1e9)
    _, (owner, _), closed = pair
    try:
        raise ZeroDivisionError
    except ZeroDivisionError:
        owner.close()
    assert closed == ["closed"]


def test_a_mean_of_one_is_what_was_given_and_closing_twice_is_fine() -> None:
    with one_shot_of_one(SIZE) as reducer:
        for k in range(3):
            mean = reducer.run_on_device(lambda mean, k=k: mean(jnp.arange(5.0) + k))
            np.testing.assert_array_equal(mean, np.arange(5.0) + k)
        assert reducer.exchange_s > 0
        reducer.close()


def test_a_device_that_takes_no_such_work_leaves_exchanges_to_the_host() -> None:
    with one_shot_of_one(SIZE, WithoutQueue) as reducer:
        with pytest.warns(RuntimeWarning, match="rank 0: CUDA_ERROR_NOT_SUPPORTED; so the host"):
            assert reducer.spmd(lambda peers, _, shared, own: (shared, own, ())) is None
        np.testing.assert_array_equal(reducer.mean(np.ones(SIZE, np.float32)), np.ones(SIZE))


def test_a_step_exchanges_no_more_than_there_is_room_for() -> None:
    def step(peers: Peers, _: Any, shared: Array, own: Array) -> tuple[Array, Array, Array]:
        return peers.gather(shared)[0], own, peers.mean(own)

    with one_shot_of_one(SIZE) as reducer:
        program = reducer.spmd(step)
        assert program is not None
        assert program.exchange_s is None
        with pytest.raises(CollectiveError, match="rank 0: 6 floats, room is for 5"):
            program.trace((), jnp.ones(SIZE + 1), jnp.ones(2))
        with pytest.raises(CollectiveError, match="exchanges float32, not bfloat16"):
            program.trace((), jnp.ones(SIZE, jnp.bfloat16), jnp.ones(2))
        program.trace((), jnp.ones(SIZE), jnp.ones(2))
        program.compile()
        shared, own, told = program(jnp.arange(5.0), jnp.full(2, 3.0))
        with pytest.raises(CollectiveError, match="mean before the last step was waited for"):
            reducer.mean(np.ones(SIZE, np.float32))
        program.wait()
        np.testing.assert_array_equal(reducer.mean(np.ones(SIZE, np.float32)), np.ones(SIZE))
        np.testing.assert_array_equal(shared, np.arange(5.0))
        np.testing.assert_array_equal(told, own)


class Failed:
    """A gradient whose program has failed."""

    dtype, shape = np.dtype(np.float32), (SIZE,)

    def block_until_ready(self) -> None:
        raise RuntimeError("INTERNAL: launch failed\nmore")


def test_a_gradient_that_failed_is_looked_into(host: HostExchange) -> None:
    reducer = OneShotReducer(host, Layout.even(1, 1), SIZE, FakeDeviceMemory)
    with pytest.raises(CollectiveError, match=r"rank 0: mean, step \d+: INTERNAL: launch failed$"):
        reducer.mean_on_device(Failed())
    reducer.close()


@given(
    st.lists(st.integers(0, 3), min_size=1, max_size=8),
    st.permutations(range(8)),
    st.lists(st.booleans(), min_size=16, max_size=16),
    st.integers(0, 4),
)
def test_one_of_two_ranks_sees_that_they_come_in_different_orders(
    kinds: list[int], order: list[int], is_first: list[bool], steps_before: int
) -> None:
    """Whoever is ahead, by the end of the step; and neither if the order is the same."""
    flags = np.zeros((64, 16), np.uint32)
    ranks = [Order(flags, rank, 2) for rank in (0, 1)]
    for _ in range(steps_before):
        assert [rank.come_to(5) for rank in ranks] == [None, None]
    other = [kinds[place] for place in order if place < len(kinds)]
    todo = [list(kinds), list(other)]
    seen = []
    for first in (*is_first, *[True] * 8, *[False] * 8):
        rank = 0 if first else 1
        if todo[rank]:
            seen.append(ranks[rank].come_to(todo[rank].pop(0)))
    assert any(peer is not None for peer in seen) == (other != kinds)
    assert not flags[:2, 0].any()  # These are the devices'.
