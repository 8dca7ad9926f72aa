"""What every way of a channel and the channels promise: both ends here, then real processes.

No jax is in them.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from training_jobs import require_gone, shared_memory

from gmijax.channels.batcher import ChannelReader
from gmijax.channels.build import ChannelTopology
from gmijax.channels.migrator import ChannelWriter
from gmijax.channels.pipe import Message, PipeReader, PipeWriter
from gmijax.channels.pipe_block import PipeBlock, create_pipes
from gmijax.channels.tcp_channel import RemoteReader, RemoteWriter
from gmijax.collectives.nodes.rendezvous import reserved_address
from gmijax.config.channel import ChannelConfig
from gmijax.errors import CollectiveError, PipeClosed
from tests.channel_job import ChannelJob

pytestmark = pytest.mark.timeout(120)

# The node of every rank: memory, and TCP. Where experience stays on the device it needs agents and
# trainers on one: tests of its own.
TRANSPORTS: dict[str, Any] = {"memory": None, "tcp": range(5)}
BOTH = (0, 0, 1, 1, 0)  # Memory for agents 0 and 1 with trainer 4, and agent 2 with trainer 3.
# A design goes through any transport alike, so each of both is here at least once.
WAYS = [("multi", None), ("multi", range(5)), ("uni", None), ("multi", BOTH)]
HERE = str(Path(__file__).parents[1])
TOPOLOGY = ChannelTopology(agents=(0, 1, 2), trainers=(3, 4), gpu_of=(0, 0, 1, 2, 3))

CAPACITY = 2**16


class Way(NamedTuple):
    """Both ends of the way from rank 0 to rank 1, in one process."""

    writer: ChannelWriter
    reader: ChannelReader

    def send(self, *parts: bytes) -> None:
        """Sends a message when there is room."""
        sizes = [len(part) for part in parts]
        views = until(lambda: self.writer.try_reserve(sizes))
        for view, part in zip(views, parts, strict=True):
            view[:] = np.frombuffer(part, np.uint8)
        self.writer.commit()

    def get(self) -> list[bytes]:
        """The next message, once it is there."""
        message: Message = until(self.reader.try_get)
        return [part.tobytes() for part in message]


def until(ready: Callable[[], Any], longest_s: float = 30.0) -> Any:
    """What `ready` returns once it is neither None nor False."""
    deadline_s = time.monotonic() + longest_s
    while (result := ready()) is None or result is False:
        assert time.monotonic() < deadline_s
        time.sleep(1e-4)
    return result


@pytest.fixture(params=TRANSPORTS)
def way(request: pytest.FixtureRequest) -> Iterator[Way]:
    with ExitStack() as held:
        if request.param == "memory":
            fd = create_pipes(2, CAPACITY)
            held.callback(os.close, fd)
            blocks = [held.enter_context(closing(PipeBlock(fd, rank))) for rank in (0, 1)]
            ends = Way(PipeWriter(blocks[0], 1), PipeReader(blocks[1], 0))
        else:
            address = held.enter_context(reserved_address("127.0.0.1"))
            settings = CAPACITY, os.urandom(32)
            reader = RemoteReader(address, 1, 0, *settings)
            ends = Way(RemoteWriter(address, 0, 1, *settings), reader)
        yield ends
        ends.reader.close()
        ends.writer.close()


def test_messages_of_all_sizes_arrive_whole_and_in_order(way: Way) -> None:
    sizes = [0, 1, 7, 5000, 20_000]

    def parts_of(number: int) -> list[bytes]:
        size = sizes[number % len(sizes)]
        return [bytes([number % 251]) * count for count in (8, size, 0, 3)]

    def write() -> None:
        for number in range(300):
            way.send(*parts_of(number))

    writing = threading.Thread(target=write)
    writing.start()
    for number in range(300):
        assert way.get() == parts_of(number)
    writing.join()


def test_what_the_reader_holds_is_room_that_the_writer_has_not(way: Way) -> None:
    part = bytes(CAPACITY // 8)
    sent = 0
    while (views := way.writer.try_reserve([len(part)])) is not None:
        views[0][:] = 1
        way.writer.commit()
        sent += 1
    assert 4 <= sent <= 8
    assert way.writer.occupancy() > 0.5
    assert way.writer.load_bytes() >= sent * len(part)
    held = until(way.reader.try_get)
    assert way.writer.try_reserve([len(part)]) is None, "views of the reader are overwritten"
    assert (held[0] == 1).all()
    way.reader.release()
    assert until(lambda: way.writer.try_reserve([len(part)])) is not None


def test_a_message_that_never_fits_is_refused(way: Way) -> None:
    largest = way.writer.max_message_bytes
    with pytest.raises(CollectiveError, match=rf"GMI 0: a message of \d+ bytes .*most {largest}"):
        way.writer.try_reserve([largest])


def test_what_was_sent_before_the_end_arrives_and_then_the_end(way: Way) -> None:
    way.send(b"first")
    way.send(b"last")
    closing_end = threading.Thread(target=way.writer.close)
    closing_end.start()
    assert [way.get(), way.get()] == [[b"first"], [b"last"]]
    with pytest.raises(PipeClosed, match="GMI 0 has closed"):
        until(way.reader.try_get)
    closing_end.join()


def test_a_writer_finds_out_that_its_reader_has_left(way: Way) -> None:
    way.send(b"taken")
    assert way.get() == [b"taken"]
    way.reader.close()
    with pytest.raises(PipeClosed, match="GMI 1 has closed"):
        until(lambda: way.writer.try_reserve([1]) is None)


def config(**keys: Any) -> ChannelConfig:
    return ChannelConfig(**{"capacity_mib": 1, **keys})


def require_all_once(job: ChannelJob, count: int) -> None:
    """Every unroll of every agent reached one trainer, once; each trainer got them in order."""
    for agent in job.topology.agents:
        parts = [job.numbers(trainer, agent) for trainer in job.topology.trainers]
        for part in parts:
            assert (np.diff(part) > 0).all()
        np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(count))


@pytest.mark.parametrize(("design", "node_of"), WAYS)
def test_nothing_is_lost_doubled_torn_or_out_of_order(
    design: Any, node_of: Any, tmp_path: Path
) -> None:
    """10^5 unrolls with pauses; batches neither fit into transfers nor the other way round."""
    count = 33_600
    task = {"count": count, "envs": 200, "batch": 77, "steps": 2, "pause_chance": 0.1}
    settings = config(design=design)
    with ChannelJob(tmp_path, settings, TOPOLOGY, node_of, **task).start() as job:
        for rank in job.ranks:
            assert job.result(rank)["error"] is None, job.result(rank)
        require_all_once(job, count)
        assert sum(job.result(trainer)["unrolls"] for trainer in (3, 4)) >= 3 * count


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_the_trainer_with_less_to_do_gets_more(transport: str, tmp_path: Path) -> None:
    topology = ChannelTopology(agents=(0,), trainers=(1, 2), gpu_of=(0, 1, 2))
    task = {"count": 20_000, "envs": 100, "batch": 100, "sizes": (50, 2), "pause_chance": 1.0}
    # Room for all of it, so that only the load decides.
    settings = config(capacity_mib=32)
    with ChannelJob(tmp_path, settings, topology, TRANSPORTS[transport], **task) as job:
        job.start(1, busy_s=0.1).start(2).wait_for("open")
        job.start(0)
        slow, quick = (job.result(rank)["unrolls"] for rank in (1, 2))
        assert slow + quick == 20_000
        assert quick > 3 * slow


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_an_agent_that_finds_no_room_waits_as_configured(transport: str, tmp_path: Path) -> None:
    topology = ChannelTopology(agents=(0,), trainers=(1,), gpu_of=(0, 0))
    task = {"count": 10**6, "envs": 100, "batch": 100, "sizes": (50, 2), "timeout_s": 1.0}
    with ChannelJob(tmp_path, config(), topology, TRANSPORTS[transport], **task) as job:
        job.start(1, timeout_s=30.0).wait_for("open")
        job.signal(1, signal.SIGSTOP)
        job.start(0)
        result = job.result(0)
        # `send` returned False; the process of the test makes an error of it.
        assert (result["error"], result["peers"]) == ("CollectiveTimeout", [1])


@pytest.mark.parametrize(
    ("transport", "victim"), [("memory", 0), ("tcp", 0), ("tcp", 4), ("device", 0)]
)
def test_a_killed_process_is_named_and_leaves_nothing(
    transport: str, victim: int, tmp_path: Path
) -> None:
    before, settings, node_of = shared_memory(), config(), TRANSPORTS.get(transport)
    topology, task = TOPOLOGY, {"count": 10**7, "envs": 50, "pause_chance": 0.5, "timeout_s": 60.0}
    if transport == "device":
        settings = config(transport="device")
        topology = ChannelTopology(agents=(0, 1), trainers=(2,), gpu_of=(0, 0, 0))
        task |= {"batch": 50, "fake_device": HERE}
    with ChannelJob(tmp_path, settings, topology, node_of, **task).start() as job:
        job.wait_for("open")
        time.sleep(0.3)
        job.signal(victim, signal.SIGKILL)
        others = topology.trainers if victim in topology.agents else topology.agents
        for rank in others:
            result = job.result(rank)
            assert (result["error"], result["peers"]) == ("PeerLost", [victim])
    require_gone(shared_memory, before)


@pytest.mark.parametrize(("trainers", "batch"), [((2,), 25), ((2, 3), 100)])
def test_experience_on_the_device_arrives_whole_and_once(
    trainers: tuple[int, ...], batch: int, tmp_path: Path
) -> None:
    topology = ChannelTopology(agents=(0, 1), trainers=trainers, gpu_of=(0,) * (2 + len(trainers)))
    task = {"count": 5000, "envs": 50, "batch": batch, "steps": 2, "pause_chance": 0.1}
    with ChannelJob(
        tmp_path, config(transport="device"), topology, fake_device=HERE, timeout_s=30.0, **task
    ) as job:
        job.start(*trainers)
        job.wait_for("open")  # Agents that end before wait a few seconds only.
        job.start(*topology.agents)
        for rank in job.ranks:
            assert job.result(rank)["error"] is None
        require_all_once(job, 5000)
