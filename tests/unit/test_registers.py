"""Registers in shared memory that nobody waits for."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

from gmijax.channels import registers
from gmijax.channels.registers import Register, create_registers, open_registers
from gmijax.collectives.shared_memory import Fence


@pytest.fixture
def fd():
    made = create_registers()
    yield made
    os.close(made)


def test_a_reader_gets_the_newest_value_once(fd) -> None:
    writer, reader = open_registers(fd, [8, 64])[1], open_registers(fd, [8, 64])[1]
    assert reader.read() is None
    for version in range(1, 4):
        writer.publish(np.full(3, version, np.float32), tag=10 * version)
    snapshot = reader.read()
    assert snapshot is not None
    assert (snapshot.count, snapshot.tag) == (3, 30)
    np.testing.assert_array_equal(snapshot.values.view(np.float32), [3, 3, 3])
    assert reader.read(snapshot.count) is None
    assert open_registers(fd, [8, 64])[0].read() is None  # Registers are apart.


class Interrupted(Fence):
    """A fence of a reader or a writer at which something else happens first, each time."""

    def __init__(self) -> None:
        super().__init__()
        self.events: list[Callable[[], object]] = []

    def __call__(self) -> None:
        if self.events:
            self.events.pop(0)()


class Pair(NamedTuple):
    """A writer and a reader of one register, each with its fence."""

    writer: Register
    reader: Register
    at_writer: Interrupted
    at_reader: Interrupted


@pytest.fixture
def pair(fd, monkeypatch: pytest.MonkeyPatch) -> Pair:
    at_writer, at_reader = fences = Interrupted(), Interrupted()
    monkeypatch.setattr(registers, "Fence", partial(next, iter(fences)))
    [writer], [reader] = (open_registers(fd, [16]) for _ in fences)
    return Pair(writer, reader, at_writer, at_reader)


def nothing() -> None:
    pass


class Killed(Exception):
    """The writer's process has ended."""


def die() -> None:
    raise Killed


def test_a_value_that_is_torn_is_not_given_out(pair: Pair) -> None:
    writer, reader = pair.writer, pair.reader
    publish = [partial(writer.publish, np.full(4, k, np.int32), tag=k) for k in range(4)]
    for once in publish[:2]:
        once()

    def die_in_the_fourth() -> None:
        """After the third and half of the fourth, which goes where the second one is."""
        publish[2]()
        pair.at_writer.events = [nothing, die]
        with pytest.raises(Killed):
            publish[3]()

    pair.at_reader.events = [nothing, die_in_the_fourth]
    snapshot = reader.read()
    assert snapshot is not None
    assert (snapshot.count, snapshot.tag, snapshot.values.view(np.int32)[0]) == (3, 2, 2)


def test_a_reader_gives_up_on_a_writer_that_is_always_faster(pair: Pair) -> None:
    writer, reader = pair.writer, pair.reader
    writer.publish(np.zeros(4, np.int32))

    def publish_twice() -> None:
        for _ in range(2):
            writer.publish(np.zeros(4, np.int32))

    pair.at_reader.events = [nothing, publish_twice] * 3
    assert reader.read() is None
    snapshot = reader.read()
    assert snapshot is not None
    assert snapshot.count == 7


WRITER = """
import sys
import numpy as np
from gmijax.channels.registers import open_registers

register, number = open_registers(int(sys.argv[1]), [int(sys.argv[2])])[0], 0
print("ready", flush=True)
while True:
    number += 1
    register.publish(np.full(int(sys.argv[2]) // 4 - number % 100, number, np.int32), tag=number)
"""


def test_readers_of_another_process_see_whole_values_only(fd) -> None:
    size = 400_000
    reader = open_registers(fd, [size])[0]
    seen: list[int] = []
    command = [sys.executable, "-c", WRITER, str(fd), str(size)]
    with subprocess.Popen(command, pass_fds=[fd], stdout=subprocess.PIPE) as writer:
        try:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"ready\n"
            while len(seen) < 200:
                assert writer.poll() is None
                if (snapshot := reader.read(seen[-1] if seen else 0)) is not None:
                    values = snapshot.values.view(np.int32)
                    assert (values == snapshot.tag).all()
                    assert values.size == size // 4 - snapshot.tag % 100
                    assert snapshot.tag == snapshot.count
                    seen.append(snapshot.count)
        finally:
            writer.kill()
    assert seen == sorted(set(seen))
