"""Slots in device memory of one rank, with memory that is not a GPU's."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeAlias

import numpy as np
import pytest
from fake_device_memory import FakeDeviceMemory
from hypothesis import given
from hypothesis import strategies as st
from shared_ranks import host_ranks

from gmijax.collectives.device.ipc_buffers import IpcBuffers
from gmijax.collectives.device_transport import DesyncDetector
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.errors import DeviceMemoryUnavailable

SIZE = 5

Pair: TypeAlias = tuple[list[SharedMemoryGroup], list[IpcBuffers], list[str]]


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


def test_what_was_made_before_a_failure_is_closed() -> None:
    (host,) = host_ranks(SIZE)
    message = "wish: GMI 0: no more memory"
    with (
        pytest.warns(RuntimeWarning, match="wish: no more memory"),
        pytest.raises(DeviceMemoryUnavailable, match=message),
    ):
        IpcBuffers(host, SIZE, [0], [0, 0], Counted, "wish")
    assert Counted.num_open == 0


@pytest.fixture
def pair() -> Iterator[Pair]:
    """Two ranks with slots in the memory of the first; what was closed is noted."""
    closed: list[str] = []

    class Noted(FakeDeviceMemory):
        def close(self) -> None:
            super().close()
            closed.append("closed")

    hosts = host_ranks(SIZE, SIZE)
    with ThreadPoolExecutor(2) as pool:
        making = [
            pool.submit(IpcBuffers, host, SIZE, [0, 1], [0], Noted, "wish") for host in hosts
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
    monkeypatch.setattr("gmijax.collectives.device.ipc_buffers.CLOSE_S", 1e9)
    hosts, (owner, _), closed = pair
    hosts[1].barrier.leave()
    owner.close()
    assert closed == ["closed"]


@pytest.mark.timeout(20)
def test_who_failed_does_not_wait_to_close(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gmijax.collectives.device.ipc_buffers.CLOSE_S", 1e9)
    _, (owner, _), closed = pair
    try:
        raise ZeroDivisionError
    except ZeroDivisionError:
        owner.close()
    assert closed == ["closed"]


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
    ranks = [DesyncDetector(flags, rank, 2) for rank in (0, 1)]
    for _ in range(steps_before):
        assert [rank.record(5, 9) for rank in ranks] == [None, None]
    other = [kinds[place] for place in order if place < len(kinds)]
    todo = [list(kinds), list(other)]
    seen = []
    for first in (*is_first, *[True] * 8, *[False] * 8):
        rank = 0 if first else 1
        if todo[rank]:
            seen.append(ranks[rank].record(todo[rank].pop(0), 9))
    assert any(peer is not None for peer in seen) == (other != kinds)
    assert not flags[:2, 0].any()  # These are the devices'.
