"""Registers between nodes: both ends in one process."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np
import pytest
from training_jobs import wait_until

from gmijax.channels.registers import RemoteRegisters
from gmijax.collectives.nodes.rendezvous import reserved_address
from gmijax.errors import CollectiveError

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


def split(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    return host, int(port)


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
        other, agent = ends(address, os.urandom(32))
        other.own(0).publish(np.array([1, 2]))
        agent.own(0).publish(np.ones(3))
        time.sleep(0.5)
        assert agent.of(0, 0).read() is None
        assert other.of(7, 0).read() is None
        for end in (other, agent):
            end.close()


def test_what_was_published_last_arrives_though_its_process_has_left(
    pair: tuple[RemoteRegisters, RemoteRegisters],
) -> None:
    leader, agent = pair
    leader.own(0).publish(np.array([1, 2]))
    wait(agent.of(0, 0).read)
    agent.own(0).publish(np.ones(3))
    agent.close()
    assert wait(leader.of(7, 0).read).values.view(np.float64).tolist() == [1, 1, 1]


@pytest.mark.parametrize("comes", ["before", "after"])
def test_unauthenticated_clients_change_nothing_of_what_is_published(comes: str) -> None:
    """A thousand quick ones, before the leader is there or after."""
    with reserved_address("127.0.0.1") as address, ExitStack() as held:
        agent = RemoteRegisters(
            7, {0: address}, [REPORT], [ORDERS, WEIGHTS], listens=True, secret=SECRET
        )
        held.callback(agent.close)

        def lead() -> RemoteRegisters:
            leader = RemoteRegisters(
                0, {7: address}, [ORDERS, WEIGHTS], [REPORT], listens=False, secret=SECRET
            )
            held.callback(leader.close)
            leader.own(0).publish(np.array([1, 2]))
            wait(agent.of(0, 0).read)
            return leader

        leader = lead() if comes == "after" else None
        for _ in range(1000):
            with suppress(OSError), socket.create_connection(split(address), 5.0) as client:
                client.sendall(b"noise" * 600)
        leader = leader or lead()
        for number in range(3, 6):
            leader.own(0).publish(np.array([number, 2]))
            agent.own(0).publish(np.full(3, number))
            at = number - 1
            orders = wait(lambda at=at: agent.of(0, 0).read(after=at - 1))
            assert orders.values.view(np.int64).tolist() == [number, 2]
            report = wait(lambda at=at: leader.of(7, 0).read(after=at - 2))
            assert report.values.view(np.int64)[0] == number
