"""Nested data as bytes, and the frames that carry them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_device_memory import FakeDeviceMemory
from shared_ranks import pipe_blocks

from gmijax.channels.device_arrays import DeviceBuffers
from gmijax.channels.mailboxes import COLLECTIVE, DATA, MAX_PARTS, Inbox, frames_of
from gmijax.channels.messenger import MIN_CAPACITY_BYTES, Messenger
from gmijax.channels.pipe import message_bytes
from gmijax.channels.trees import as_bytes, flatten, unflatten
from gmijax.errors import CollectiveTimeout, ConfigError
from tests.role_cases import nested, same


def round_trip(tree: Any, *, scalars: bool = False) -> Any:
    skeleton, arrays = flatten(tree, scalars=scalars)
    return unflatten(skeleton, [as_bytes(array).copy() for array in arrays])


def test_more_than_numbers_is_pickled_as_it_is() -> None:
    masked = np.ma.array([1.0, 2.0], mask=[True, False])
    back = round_trip([masked, np.array([None, "text"], object)])
    assert back[0].mask.tolist() == [True, False]
    assert back[1].tolist() == [None, "text"]


def test_arrays_of_jax_become_arrays_of_numpy() -> None:
    back = round_trip({"half": jnp.ones((2, 3), jnp.bfloat16), "one": jnp.float32(2.0)})
    assert [type(leaf) for leaf in back.values()] == [np.ndarray] * 2
    assert back["half"].dtype == jnp.bfloat16
    assert back["half"].tolist() == [[1.0] * 3] * 2
    assert (back["one"].shape, back["one"].item()) == ((), 2.0)
    with pytest.raises(TypeError, match="key_data"):  # A random key says what to send instead.
        flatten({"key": jax.random.key(0)})


def test_floats_are_arrays_only_where_asked_for() -> None:
    assert flatten([1.5, np.float32(2)])[1] == []
    _, arrays = flatten([1.5, np.float32(2), 3, True], scalars=True)
    assert [array.item() for array in arrays] == [1.5, 2.0]
    assert round_trip({"loss": 0.5}, scalars=True) == {"loss": 0.5}


@pytest.mark.parametrize("frame_bytes", [1, 7, 100, 10**6])
def test_messages_may_be_cut_anywhere(frame_bytes: int) -> None:
    inbox = Inbox()
    for seed, tag in enumerate((DATA, COLLECTIVE, DATA)):
        for frame in frames_of(nested(seed), tag, frame_bytes):
            assert sum(part.size for part in frame) <= frame_bytes
            inbox.feed(frame)
    assert [len(inbox.ready[tag]) for tag in (DATA, COLLECTIVE)] == [2, 1]
    assert same(inbox.ready[DATA][1], nested(2))
    assert same(inbox.ready[COLLECTIVE][0], nested(1))


def test_every_frame_fits_into_the_smallest_pipe() -> None:
    many = [np.ones(size % 90, np.float32) for size in range(3000)]
    frames = frames_of(many, DATA, MIN_CAPACITY_BYTES // 4)
    assert max(map(len, frames)) <= MAX_PARTS
    largest = max(message_bytes([part.size for part in frame]) for frame in frames)
    assert largest <= MIN_CAPACITY_BYTES // 2


@pytest.fixture
def alone() -> Messenger:
    return Messenger(pipe_blocks(2)[0], timeout_s=0.05)


def test_who_does_not_take_what_was_sent_is_named(alone: Messenger) -> None:
    alone.send(np.ones(10**6), 1)  # Does not wait, although the pipe is too small.
    with pytest.raises(CollectiveTimeout, match=r"in flush, step 0, for GMIs \[1\]"):
        alone.flush()


def test_messages_to_oneself(alone: Messenger) -> None:
    data = np.ones(10**6)
    alone.send(data, 0)
    data[:] = 2
    assert alone.recv(0).sum() == 10**6
    with pytest.raises(CollectiveTimeout, match=r"in recv, step 1, for GMIs \[0\]"):
        alone.recv(0)


@pytest.mark.parametrize("rank", [-1, 2, 0.5, "1"])
def test_ranks_that_there_are_not(alone: Messenger, rank: int) -> None:
    with pytest.raises(ConfigError, match=r"dst=.*: there are GMIs 0 to 1"):
        alone.send("hello", rank)
    with pytest.raises(ConfigError, match=r"src=.*: there are GMIs 0 to 1"):
        alone.recv(rank)


def posts(
    count: int, part_bytes: int = 1 << 20, timeout_s: float = 5.0, memory: Any = FakeDeviceMemory
) -> list[Messenger]:
    """Messengers of `count` ranks that share memory of a device, in this process."""
    return patient([timeout_s] * count, part_bytes, memory)


def patient(
    timeouts_s: Sequence[float], part_bytes: int = 1 << 20, memory: Any = FakeDeviceMemory
) -> list[Messenger]:
    """The same with a time limit for each rank."""
    count = len(timeouts_s)
    others = [[peer for peer in range(count) if peer != rank] for rank in range(count)]
    return [
        Messenger(block, timeout_s, DeviceBuffers(peers, memory, part_bytes))
        for block, timeout_s, peers in zip(pipe_blocks(count), timeouts_s, others, strict=True)
    ]


def test_arrays_of_jax_stay_on_the_device_that_ranks_share() -> None:
    first, second, third = posts(3)
    large = jnp.arange(5000.0).reshape(50, 100)
    first.send({"large": large, "flags": large > 7, "small": jnp.ones(3), "n": 7}, 1)
    first.send(large + 1, 2)
    got = second.recv(0)
    assert isinstance(got["large"], jax.Array)
    assert isinstance(got["small"], np.ndarray)  # Through the host it is as quick.
    assert got["n"] == 7
    np.testing.assert_array_equal(got["large"], large)
    np.testing.assert_array_equal(got["flags"], large > 7)
    np.testing.assert_array_equal(third.recv(0), large + 1)


def test_places_on_the_device_are_used_again_and_never_too_early() -> None:
    first, second = posts(2, part_bytes=3 * 20_000)
    sent = [jnp.full(5000, float(number)) for number in range(40)]
    kinds: list[type] = []
    for number in range(0, 40, 8):
        for array in sent[number : number + 8]:
            first.send(array, 1)
        for array in sent[number : number + 8]:
            got = second.recv(0)
            kinds.append(type(got))
            np.testing.assert_array_equal(got, array)
    # There is room for two or three at once; the others go through the host.
    assert 10 <= sum(issubclass(kind, jax.Array) for kind in kinds) < 40


def test_a_rank_may_end_when_what_it_left_on_the_device_is_received() -> None:
    first, second = posts(2)
    first.send(np.arange(5000.0), 1)
    assert first.drain(0.01)  # In shared memory it outlives its sender.
    second.recv(0)
    for sender, receiver in ((first, 1), (second, 0)):
        sender.send(jnp.arange(5000.0), receiver)
    first.flush()
    assert not first.drain(0.01)  # It has taken what came, so the other one may end.
    assert second.drain(0.01)
    assert first.drain(0.01)
    np.testing.assert_array_equal(first.recv(1), np.arange(5000.0))  # It is not lost by that.


def test_what_was_not_sent_for_want_of_room_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gmijax.channels.mailboxes.MAX_WAITING_BYTES", 1)
    first, second = patient([0.1, 30.0])
    first.send(np.ones(10**6), 1)
    with pytest.raises(CollectiveTimeout, match=r"in send, step 2, for GMIs \[1\]"):
        first.send(jnp.arange(5000.0), 1)
    assert second.recv(0).size == 10**6
    assert first.drain(30.0)
    first.send(jnp.arange(5000.0), 1)
    assert not first.drain(0.01)
    np.testing.assert_array_equal(second.recv(0), np.arange(5000.0))
    assert first.drain(30.0)


def test_without_shared_memory_of_a_device_all_go_through_the_host() -> None:
    class Refused(FakeDeviceMemory):
        def create(self, num_bytes: int) -> bytes:
            raise RuntimeError("no IPC here")

    first, second = posts(2, memory=Refused)
    first.send(jnp.arange(5000.0), 1)
    assert isinstance(second.recv(0), np.ndarray)
