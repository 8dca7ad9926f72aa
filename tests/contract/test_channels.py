"""What the experience channels promise, checked with real processes; no jax in them."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training_jobs import require_gone, shared_memory

from gmijax.channels.build import ChannelTopology
from gmijax.config.channel import ChannelConfig
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
    # Room for all of it, so that only the load can tell.
    settings = config(capacity_mib=32)
    with ChannelJob(tmp_path, settings, topology, TRANSPORTS[transport], **task) as job:
        job.start(1, busy_s=0.1).start(2).wait_for("open")
        job.start(0)
        slow, quick = (job.result(rank)["unrolls"] for rank in (1, 2))
        assert slow + quick == 20_000
        assert quick > 3 * slow


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_an_agent_that_finds_no_room_waits_as_told(transport: str, tmp_path: Path) -> None:
    topology = ChannelTopology(agents=(0,), trainers=(1,), gpu_of=(0, 0))
    task = {"count": 10**6, "envs": 100, "batch": 100, "sizes": (50, 2), "timeout_s": 1.0}
    with ChannelJob(tmp_path, config(), topology, TRANSPORTS[transport], **task) as job:
        job.start(1, timeout_s=30.0).wait_for("open")
        job.signal(1, signal.SIGSTOP)
        job.start(0)
        result = job.result(0)
        # `send` said False; the process of the test makes an error of it.
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
