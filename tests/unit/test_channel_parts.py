"""The parts of the experience channels, each alone; processes are in the contract tests."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from gmijax.channels.batcher import Batcher
from gmijax.channels.build import (
    ChannelTopology,
    create_channels,
    max_piece_bytes,
    open_receiver,
    open_sender,
    require_memory,
)
from gmijax.channels.sender import CLOSE_TIMEOUT_S, Dispenser, Sender
from gmijax.config.channel import ChannelConfig
from gmijax.errors import CollectiveTimeout, ConfigError, PeerLost, PipeClosed

TOPOLOGY = ChannelTopology(agents=(0,), trainers=(1,), gpu_of=(0, 0))
T, N, O = 4, 6, 3


def rollout(first: int = 0, envs: int = N) -> dict[str, Any]:
    number = np.arange(first, first + envs, dtype=np.float32)
    state = np.broadcast_to(number[:, None], (T + 1, envs, O)).copy()
    return {"state": state, "done": np.tile(number % 2 == 0, (T, 1)), "bootstrap": number[None]}


class Pair:
    """Both ends in one process."""

    def __init__(self, **keys: Any) -> None:
        config = ChannelConfig(**{"capacity_mib": 1, **keys})
        self.fd = create_channels(config, TOPOLOGY)
        self.sender: Sender = open_sender(config, TOPOLOGY, 0, self.fd)
        self.receiver: Batcher = open_receiver(config, TOPOLOGY, 1, self.fd)

    def numbers(self, batch_size: int) -> list[int]:
        batch = self.receiver.receive(batch_size, 0.0)
        number = batch.experience["bootstrap"][0]
        assert (batch.experience["state"] == number[:, None]).all()
        assert batch.experience["state"].shape == (T + 1, batch_size, O)
        assert (batch.experience["done"] == (number % 2 == 0)).all()
        assert not batch.experience["state"].flags.writeable
        assert batch.experience["done"].dtype == bool
        return number.astype(int).tolist()


@pytest.fixture
def make_pair() -> Iterator[Any]:
    made: list[Pair] = []

    def make(**keys: Any) -> Pair:
        made.append(Pair(**keys))
        return made[-1]

    yield make
    for pair in made:
        pair.sender.close()
        pair.receiver.close()
        os.close(pair.fd)


@pytest.mark.parametrize("design", ["multi", "uni"])
@pytest.mark.parametrize("batch", [1, 2, 4, 6, 9, 12])
def test_batches_slice_and_stack(make_pair: Any, design: str, batch: int) -> None:
    pair = make_pair(design=design)
    for send in range(6):
        assert pair.sender.send(rollout(send * N), send, 1.0)
    pair.sender.flush()
    got = [number for _ in range(6 * N // batch) for number in pair.numbers(batch)]
    assert got == list(range(6 * N))
    with pytest.raises(CollectiveTimeout, match=r"GMI 1: waited 0 s in receive.*GMIs \[0\]"):
        pair.receiver.receive(batch, 0.0)


def test_a_timeout_loses_nothing_and_the_batch_size_may_change(make_pair: Any) -> None:
    pair = make_pair()
    pair.sender.send(rollout(), 0, 1.0)
    pair.sender.flush()
    with pytest.raises(CollectiveTimeout):
        pair.receiver.receive(2 * N, 0.0)
    assert pair.numbers(2) == [0, 1]
    assert pair.numbers(N - 2) == [2, 3, 4, 5]
    pair.sender.close()
    with pytest.raises(PipeClosed, match="GMI 0 has closed"):
        pair.receiver.receive(1, 0.0)


def test_small_rollouts_travel_together_large_ones_are_cut(make_pair: Any) -> None:
    one = sum(array[:, :1].nbytes for array in rollout().values())
    pair = make_pair()
    pair.sender.migrator.try_open = opened = Mock(wraps=pair.sender.migrator.try_open)
    for send in range(20):
        pair.sender.send(rollout(send * N), 0, 1.0)
    pair.sender.flush()
    assert pair.numbers(20 * N)[-1] == 20 * N - 1
    assert opened.call_count == 1
    large = max_piece_bytes(2**20) // one + 1
    pair.sender.send(rollout(20 * N, large), 0, 1.0)
    pair.sender.flush()
    assert pair.numbers(large)[-1] == 20 * N + large - 1
    assert opened.call_count == 3


@pytest.mark.parametrize("is_lost", [False, True])
def test_without_room_or_after_an_error_a_send_goes_on_where_it_was(
    make_pair: Any, is_lost: bool
) -> None:
    pair = make_pair()
    one = sum(array[:, :1].nbytes for array in rollout().values())
    large = rollout(0, 3 * (2**20 // one))
    if is_lost:
        pair.sender.migrator.check()  # The next look is a while away.
        pair.sender.migrator.why_lost = lambda: PeerLost(0, 1, "send", 0)
        with pytest.raises(PeerLost):
            pair.sender.send(large, 0, 0.3)
        pair.sender.migrator.why_lost = lambda: None
    else:
        assert not pair.sender.send(large, 0, 0.01)
        assert pair.sender.waited_s > 0
    got = pair.numbers(1000)
    while not pair.sender.send(large, 0, 0.0):
        got += pair.numbers(1000)
    pair.sender.close()
    while len(got) + 1000 <= len(large["bootstrap"][0]):
        got += pair.numbers(1000)
    assert got == list(range(len(got)))
    assert pair.sender.num_bytes == sum(array.nbytes for array in large.values())


def test_close_sends_the_rest_of_a_rollout_if_there_is_room_now(make_pair: Any) -> None:
    pair = make_pair()
    assert not pair.sender.send(rollout(0, 20_000), 0, 0.0)
    got = pair.numbers(10_000)
    pair.sender.close()
    assert got + pair.numbers(10_000) == list(range(20_000))


def test_close_gives_up_what_a_trainer_that_has_closed_did_not_take(make_pair: Any) -> None:
    pair = make_pair()
    assert not pair.sender.send(rollout(0, 20_000), 0, 0.0)
    pair.receiver.close()
    started_s = time.monotonic()
    pair.sender.close()
    assert time.monotonic() - started_s < CLOSE_TIMEOUT_S


def test_many_tiny_pieces_fit_with_their_versions_and_agents(make_pair: Any) -> None:
    pair = make_pair()
    for number in range(100):
        assert pair.sender.send({"reward": np.full((1, 1), number, np.float32)}, number, 1.0)
    pair.sender.flush()
    batch = pair.receiver.receive(100, 1.0)
    assert batch.versions.tolist() == list(range(100))
    assert batch.agents.tolist() == [0] * 100


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"state": np.zeros((T, N, O))}, r"experience.state: got float64 \[4, 6, 3\], expected"),
        ({"done": np.zeros((T, N + 1), bool)}, r"experience.done: got bool \[4, 7\], expected"),
        ({"bootstrap": np.zeros(N, np.float32)}, r"experience.bootstrap: got float32 \[6\]"),
        ({"reward": np.zeros((T, N), np.float32)}, "the first was"),
    ],
)
def test_other_experience_is_refused(change: dict[str, Any], message: str) -> None:
    dispenser = Dispenser(0, 10_000)
    assert len(dispenser.split(rollout(), 0)) == 1
    with pytest.raises(ConfigError, match=message):
        dispenser.split({**rollout(), **change}, 0)


def test_an_unroll_that_never_fits_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"bytes for one environment, at most 10; channel\."):
        Dispenser(0, 10).split(rollout(), 0)


def test_what_cannot_be_had_is_refused_before_a_process_starts() -> None:
    config = ChannelConfig(capacity_mib=1)
    require_memory(config, TOPOLOGY)
    with pytest.raises(ConfigError, match=r"1 pairs .* take 100000000 MiB, available are \d+ MiB"):
        require_memory(ChannelConfig(capacity_mib=10**8), TOPOLOGY)
    with pytest.raises(ConfigError, match="at least one of each"):
        ChannelTopology(agents=(), trainers=(0,), gpu_of=(0,))
    with pytest.raises(ConfigError, match="needs the channels of the job's controller"):
        open_sender(config, TOPOLOGY, 0, None)
