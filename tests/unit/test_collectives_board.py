"""Notes in shared memory that nobody waits for."""

from __future__ import annotations

import os
import threading

import numpy as np
import pytest

from gmijax.collectives.board import attach_board, create_board
from gmijax.errors import CollectiveError, ConfigError


@pytest.fixture
def fd():
    made = create_board()
    yield made
    os.close(made)


def test_a_reader_gets_the_newest_value_once(fd) -> None:
    writer, reader = attach_board(fd, [8, 64])[1], attach_board(fd, [8, 64])[1]
    assert reader.read() is None
    for version in range(1, 4):
        writer.publish(np.full(3, version, np.float32), tag=10 * version)
    posted = reader.read()
    assert posted is not None
    assert (posted.count, posted.tag) == (3, 30)
    np.testing.assert_array_equal(posted.values.view(np.float32), [3, 3, 3])
    assert reader.read(posted.count) is None
    assert attach_board(fd, [8, 64])[0].read() is None  # Notes are apart.


def test_a_value_that_is_torn_is_not_given_out(fd) -> None:
    writer, reader = attach_board(fd, [16])[0], attach_board(fd, [16])[0]
    writer.publish(np.arange(4, dtype=np.int32))
    writer._places[1, 0] ^= 1  # As if a second publication had begun to overwrite it.
    assert reader.read() is None
    writer._places[1, 0] ^= 1
    assert reader.read() is not None
    writer._line["tag"][0, 1] = 7  # Likewise, with the same values.
    assert reader.read() is None
    writer.publish(np.arange(4, dtype=np.int32))
    assert reader.read() is not None


def test_readers_of_a_fast_writer_see_whole_values_only(fd) -> None:
    size = 20_000
    writer, reader = attach_board(fd, [4 * size])[0], attach_board(fd, [4 * size])[0]
    stop = threading.Event()

    def publish() -> None:
        number = 0
        while not stop.is_set():
            number += 1
            writer.publish(np.full(size, number, np.int32), tag=number)

    thread = threading.Thread(target=publish)
    thread.start()
    seen: list[int] = []
    count = 0
    try:
        while len(seen) < 10:
            if (posted := reader.read(count)) is not None:
                assert (posted.values.view(np.int32) == posted.tag).all()
                count = posted.count
                seen.append(posted.tag)
    finally:
        stop.set()
        thread.join()
    assert seen == sorted(set(seen))


def test_what_does_not_fit_is_refused(fd) -> None:
    with pytest.raises(ConfigError, match=r"sizes_bytes=\[4, 0\]"):
        attach_board(fd, [4, 0])
    note = attach_board(fd, [4])[0]
    with pytest.raises(CollectiveError, match="8 bytes for a note of 4"):
        note.publish(np.zeros(2, np.float32))
    with pytest.raises(CollectiveError, match="note 0 has 4 bytes for another process, 8 here"):
        attach_board(fd, [8])
