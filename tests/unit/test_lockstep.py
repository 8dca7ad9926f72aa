"""Steps of the devices of a node's two ranks, whose leader looks at another node meanwhile."""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from shared_ranks import host_ranks

from gmijax.collectives.device.lockstep import LockstepRunner
from gmijax.collectives.device.watched_thread import end_at_once
from gmijax.collectives.nodes.multi_node_group import MultiNodeGroup
from gmijax.errors import PeerLost
from gmijax.partition.layout import Layout

SIZE = 5


class FakeWatch:
    """A `LeaderWatch` of a node that is gone once `is_gone` is set."""

    def __init__(self) -> None:
        self.is_gone = threading.Event()
        self.num_barriers = 0

    def beat(self) -> None:
        pass

    def look(self, since_s: float, timeout_s: float, operation: str, step: int) -> None:
        if self.is_gone.is_set():
            raise PeerLost(0, 2, operation, step)

    def barrier(self, *_: Any) -> None:
        self.num_barriers += 1
        self.is_gone.set()  # As at the end of a job, where each ends when all have arrived.


@pytest.fixture
def groups() -> Iterator[tuple[FakeWatch, list[MultiNodeGroup]]]:
    watch: Any = FakeWatch()
    layout = Layout(((0, 1), (2, 3)), 2)
    leader, other = host_ranks(SIZE, SIZE)
    yield watch, [MultiNodeGroup(leader, layout, 0, None, watch), MultiNodeGroup(other, layout, 1)]
    atexit.unregister(end_at_once)  # For who is caught in a step, which is this process here.


def test_a_leader_whose_own_device_is_through_sees_that_another_node_is_gone(groups) -> None:
    """Another rank of its own node may wait for that one in a ring, and cannot see it."""
    watch, ranks = groups
    runners, released = [LockstepRunner(rank, SIZE) for rank in ranks], threading.Event()
    with ThreadPoolExecutor(2) as pool:
        caught = pool.submit(runners[1].step, released.wait)
        try:
            with pytest.raises(PeerLost, match="GMI 2"):
                pool.submit(runners[0].step, watch.is_gone.set).result(20)
            ranks[0].local.close()  # As it ends.
        finally:
            released.set()
        with pytest.raises(PeerLost, match="GMI 0"):
            caught.result(20)
    assert watch.num_barriers == 0


def test_a_node_that_ends_after_the_barrier_is_not_lost(
    groups, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch, ranks = groups
    # The other rank comes after the leader has had time to look.
    monkeypatch.setattr(ranks[1], "leader_barrier", lambda: time.sleep(0.7))
    runners = [LockstepRunner(rank, SIZE) for rank in ranks]
    with ThreadPoolExecutor(2) as pool:
        steps = [pool.submit(runner.finish, lambda: True) for runner in runners]
        assert [step.result(20) for step in steps] == [True, True]
    assert watch.num_barriers == 1
