"""Slots in device memory of one rank, with memory that is not a GPU's."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from fake_device_memory import FakeDeviceMemory, WithoutQueue, one_shot_of_one

from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import Peers
from gmijax.collectives.memory import create_exchange
from gmijax.collectives.one_shot import OneShotReducer
from gmijax.collectives.shared_slots import SharedSlots
from gmijax.errors import CollectiveError, DeviceMemoryUnavailable
from gmijax.partition.layout import Layout
from gmijax.types import Array

SIZE = 5


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
