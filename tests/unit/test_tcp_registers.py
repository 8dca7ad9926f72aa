"""Registers between nodes: both ends in one process."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from training_jobs import wait_until

from gmijax.collectives.nodes.meeting import reserved_address
from gmijax.errors import CollectiveError

pytest.importorskip("zmq")

from gmijax.collectives.channel.tcp_registers import RemoteRegisters

SECRET = os.urandom(32)
ORDERS, WEIGHTS, REPORT = 16, 4096, 24


def ends(address: str, secret: bytes = SECRET) -> tuple[RemoteRegisters, RemoteRegisters]:
    """Those of a leader, rank 0, and of an agent, rank 7."""
    leader = RemoteRegisters(
        0, {7: address}, [ORDERS, WEIGHTS], [REPORT], listens=False, secret=secret
    )
    agent = RemoteRegisters(
        7, {0: address}, [REPORT], [ORDERS, WEIGHTS], listens=True, secret=SECRET
    )
    return leader, agent


@pytest.fixture
def pair() -> Iterator[tuple[RemoteRegisters, RemoteRegisters]]:
    with reserved_address("127.0.0.1") as address:
        both = ends(address)
        yield both
        for end in both:
            end.close()


def wait(read: Callable[[], Any]) -> Any:
    return wait_until(read, 60.0, "a newer value")


def test_a_reader_gets_the_newest_of_every_register_also_of_what_came_before_it_was_there(
    pair: tuple[RemoteRegisters, RemoteRegisters],
) -> None:
    leader, agent = pair
    leader.own(1).publish(np.arange(3, dtype=np.float32), tag=-5)
    leader.own(0).publish(np.array([1, 2]))
    orders, weights = agent.of(0, 0), agent.of(0, 1)
    assert wait(orders.read).values.view(np.int64).tolist() == [1, 2]
    newest = wait(weights.read)
    assert (newest.count, newest.tag) == (1, -5)
    assert newest.values.view(np.float32).tolist() == [0, 1, 2]
    assert weights.read(after=1) is None
    agent.own(0).publish(np.ones(3))
    assert wait(leader.of(7, 0).read).values.view(np.float64).tolist() == [1, 1, 1]


def test_who_reads_seldom_gets_what_is_newest_and_whole(
    pair: tuple[RemoteRegisters, RemoteRegisters],
) -> None:
    leader, agent = pair
    weights = agent.of(0, 1)
    leader.own(1).publish(np.zeros(WEIGHTS // 4, np.float32))
    wait(weights.read)
    last = 2000
    for number in range(1, last + 1):
        leader.own(1).publish(np.full(WEIGHTS // 4, number, np.float32), tag=number)
    seen = [0]
    while seen[-1] < last:
        found = wait(lambda: weights.read(after=seen[-1] + 1))
        assert (found.values.view(np.float32) == found.tag).all()
        seen.append(found.tag)
    assert seen == sorted(set(seen))
    assert len(seen) < last  # Most were never here.


def test_what_is_no_message_of_registers_is_an_error(
    pair: tuple[RemoteRegisters, RemoteRegisters],
) -> None:
    leader, agent = pair
    leader.own(0).publish(np.array([1, 2]))
    wait(agent.of(0, 0).read)
    [connection] = leader._connections.values()
    for junk in (b"", b"junk", b"x" * 200):
        connection.send([junk])
        with pytest.raises(CollectiveError, match="GMI 7: no message of registers from GMI 0"):
            wait(lambda: agent.of(0, 0).read(after=1))


def test_another_secret_gets_and_gives_nothing() -> None:
    with reserved_address("127.0.0.1") as address:
        stranger, agent = ends(address, os.urandom(32))
        stranger.own(0).publish(np.array([1, 2]))
        agent.own(0).publish(np.ones(3))
        time.sleep(0.5)
        assert agent.of(0, 0).read() is None
        assert stranger.of(7, 0).read() is None
        for end in (stranger, agent):
            end.close()


def test_an_agent_that_is_done_waits_for_the_end_of_the_leader(
    pair: tuple[RemoteRegisters, RemoteRegisters], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.collectives.channel.tcp_registers._FAREWELL_S", 60.0)
    leader, agent = pair
    agent.wait_for_ends()  # Nobody has come yet.
    leader.own(0).publish(np.array([1, 2]))
    wait(agent.of(0, 0).read)
    leader.close()
    started_s = time.monotonic()
    agent.wait_for_ends()
    assert time.monotonic() - started_s < 30.0
