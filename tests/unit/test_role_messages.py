"""Nested data as bytes, and the frames that carry them."""

from __future__ import annotations

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.collectives.mailboxes import COLLECTIVE, DATA, MAX_PARTS, Inbox, frames_of
from gmijax.collectives.messenger import MIN_CAPACITY_BYTES, Messenger
from gmijax.collectives.pipe import message_bytes
from gmijax.collectives.pipe_block import PipeBlock, create_pipes
from gmijax.collectives.trees import as_bytes, flatten, unflatten
from gmijax.errors import CollectiveTimeout, ConfigError
from tests.role_cases import nested, same


def round_trip(tree: Any, *, scalars: bool = False) -> Any:
    skeleton, arrays = flatten(tree, scalars=scalars)
    return unflatten(skeleton, [as_bytes(array).copy() for array in arrays])


def test_any_nesting_comes_back() -> None:
    assert same(round_trip(nested(3)), nested(3))


def test_arrays_of_jax_become_arrays_of_numpy() -> None:
    back = round_trip({"half": jnp.ones((2, 3), jnp.bfloat16), "one": jnp.float32(2.0)})
    assert [type(leaf) for leaf in back.values()] == [np.ndarray] * 2
    assert back["half"].dtype == jnp.bfloat16
    assert back["half"].tolist() == [[1.0] * 3] * 2
    assert (back["one"].shape, back["one"].item()) == ((), 2.0)


def test_a_random_key_says_what_to_send_in_its_place() -> None:
    with pytest.raises(TypeError, match="key_data"):
        flatten({"key": jax.random.key(0)})


def test_more_than_numbers_is_pickled_as_it_is() -> None:
    masked = np.ma.array([1.0, 2.0], mask=[True, False])
    back = round_trip([masked, np.array([None, "text"], object)])
    assert back[0].mask.tolist() == [True, False]
    assert back[1].tolist() == [None, "text"]


def test_floats_are_arrays_only_where_asked_for() -> None:
    assert flatten([1.5, np.float32(2)]).arrays == []
    assert [
        array.item() for array in flatten([1.5, np.float32(2), 3, True], scalars=True).arrays
    ] == [
        1.5,
        2.0,
    ]
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
    fd = create_pipes(2, MIN_CAPACITY_BYTES)
    try:
        return Messenger(PipeBlock.attach(fd, 0, 2, MIN_CAPACITY_BYTES), timeout_s=0.05)
    finally:
        os.close(fd)


def test_who_does_not_take_what_was_sent_is_named(alone: Messenger) -> None:
    alone.send(np.ones(10**6), 1)  # Does not wait, although the pipe is too small.
    with pytest.raises(CollectiveTimeout, match=r"in flush, step 0, for ranks \[1\]"):
        alone.flush()


def test_messages_to_oneself(alone: Messenger) -> None:
    data = np.ones(10**6)
    alone.send(data, 0)
    data[:] = 2
    assert alone.recv(0).sum() == 10**6
    with pytest.raises(CollectiveTimeout, match=r"in recv, step 1, for ranks \[0\]"):
        alone.recv(0)


@pytest.mark.parametrize("rank", [-1, 2, 0.5, "1"])
def test_ranks_that_there_are_not(alone: Messenger, rank: int) -> None:
    with pytest.raises(ConfigError, match=r"dst=.*: allowed are GMIs 0 to 1"):
        alone.send("hello", rank)
    with pytest.raises(ConfigError, match=r"src=.*: allowed are GMIs 0 to 1"):
        alone.recv(rank)
