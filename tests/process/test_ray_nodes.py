"""Training over two nodes of Ray on this machine: equal results, faults, bad input."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training_jobs import (
    FOREVER,
    POINT,
    STEPS,
    events,
    gmi_pid,
    iteration_of,
    kill,
    learner_arrays,
    pids_of,
    require_gone,
    shared_memory,
    start,
    train,
    wait_until,
)

from benchmarks.two_ray_nodes import RAY, Cluster, two_nodes
from gmijax.machine.processes import identify
from gmijax.runs.history import read_metrics

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed"),
    pytest.mark.timeout(400),
]

TWO = "plan.gmis_per_gpu=2"


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with two_nodes(tmp_path_factory.mktemp("ray") / "stderr.txt") as nodes:
        yield nodes


def children_of(parent: int) -> list[int]:
    """Processes that a process has started."""
    tasks = Path(f"/proc/{parent}/task").glob("*/children")
    return [int(pid) for task in tasks for pid in task.read_text().split()]


def family_of(parent: int) -> list[int]:
    """A process, those that it has started, and those that they have started."""
    return [parent, *(pid for child in children_of(parent) for pid in family_of(child))]


def addresses_of_listeners(pids: list[int]) -> set[str]:
    """Where these processes listen, as the kernel writes IP addresses."""
    inodes: set[str] = set()
    for pid in pids:
        with suppress(OSError):  # It has ended, or closed one of them meanwhile.
            inodes |= {os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir()}
    tables = [Path("/proc/net", name).read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
    rows = [row.split() for table in tables for row in table]
    # 0A: it listens.
    found = [row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in inodes]
    return {address.rpartition(":")[0] for address in found}


def test_two_nodes_learn_the_bits_of_two_gpus_of_one_machine(
    cluster: Cluster, tmp_path: Path
) -> None:
    steps = f"num_timesteps={3 * 4 * STEPS}"
    here = ("plan.gpus=2", "reduce.strategy=har", "run.dir=here")
    done = train(*POINT, TWO, *here, steps, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    nodes = (RAY, cluster.address, "cluster.nodes=2", "run.dir=there")
    done = train(*POINT, TWO, *nodes, steps, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    there = tmp_path / "there"
    expected = learner_arrays(tmp_path / "here")
    assert len(expected) > 10
    for array, other in zip(learner_arrays(there), expected, strict=True):
        np.testing.assert_array_equal(array, other)

    plan = json.loads((there / "plan.json").read_text())
    summary = json.loads((there / "summary.json").read_text())
    assert plan["layout"] == [[0, 1], [2, 3]]
    assert [node["gmis"] for node in plan["nodes"]] == [[0, 1], [2, 3]]
    assert summary["plan"]["nodes"] == plan["nodes"]
    assert all((there / f"gmi_{gmi}" / "stderr.log").exists() for gmi in range(4))
    assert not list(there.glob("node_*"))
    assert not pids_of(there)


def _steps_learnt(run: Path) -> int:
    lines = read_metrics(run / "metrics.jsonl")
    return lines[-1]["env_steps"] if lines else 0


def test_agents_teach_trainers_of_two_nodes_and_of_one_when_the_other_dies(
    cluster: Cluster, tmp_path: Path
) -> None:
    run, memory = tmp_path / "run", shared_memory()
    job = start(
        *(*POINT[:-1], "algo=a3c", FOREVER, RAY, cluster.address, "cluster.nodes=2"),
        # An agent without a trainer on its GPU sends to those of both nodes.
        *("plan.gpus=2", "plan.serving_gpus=[0,2]", "plan.training_gpus=[1,3]", "run.dir=run"),
        *("run.max_restarts=1", "run.elastic=true", "cluster.wait_s=1", "run.checkpoint_every=50"),
        *("algo.policy_hidden_layer_sizes=[16]", "algo.value_hidden_layer_sizes=[16]"),
        cwd=tmp_path,
    )
    stderr = tmp_path / "stderr.txt"

    def wait(condition: Any, what: str) -> Any:
        return wait_until(
            lambda: condition() or job.poll() is not None, 120, f"{what}: {stderr.read_text()}"
        )

    try:
        wait(lambda: list(run.glob("checkpoints/[0-9]*")), "agents have added to a checkpoint")
        assert job.poll() is None, stderr.read_text()
        before = json.loads((run / "plan.json").read_text())
        assert [node["gmis"] for node in before["nodes"]] == [[0, 2], [1, 3]]
        assert before["strategy"] == "mpr"
        assert addresses_of_listeners(pids_of(run)) == set()  # All have met.

        os.kill(cluster.second_raylet, signal.SIGKILL)
        wait(lambda: len(events(run, "recovered")) == 1, "it goes on without the second node")
        [fault] = events(run, "fault")
        assert re.search(r"node [01] \(.*\) is gone", fault["cause"])
        steps = int(Path(events(run, "start")[-1]["checkpoint"]).name)
        wait(lambda: _steps_learnt(run) > steps, "it learns on")
        job.send_signal(signal.SIGTERM)
        assert job.wait(120) == 130, stderr.read_text()
    finally:
        kill(job.pid)
        job.wait()
        cluster.add_node()
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["status"], summary["plan"]["layout"]) == ("interrupted", [[1], [0]])
    assert summary["env_steps"] > steps
    # They act with what the trainer publishes.
    assert summary["staleness"]["mean"] < 50
    names = {path.name for path in Path(summary["checkpoint"]).iterdir()}
    assert names == {"episodes.json", "gmi_1", "learner", "meta.json", "policy.npz"}
    assert not pids_of(run)
    require_gone(shared_memory, memory)


def test_a_job_outlives_a_gmi_and_a_node_and_nothing_outlives_its_controller(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = shared_memory()
    run = tmp_path / "run"
    job = (
        *(*POINT, FOREVER, TWO, RAY, "run.dir=run", "run.resume=auto"),
        *("run.max_restarts=3", "run.elastic=true", "cluster.wait_s=1", "run.checkpoint_every=5"),
    )
    controller = start(*job, cluster.address, cwd=tmp_path)
    try:
        stderr = tmp_path / "stderr.txt"

        def wait(condition: Any, what: str) -> Any:
            return wait_until(
                lambda: condition() or controller.poll() is not None, 120, f"{what}: {stderr}"
            )

        wait(lambda: iteration_of(run, 3) > 6, "the job trains")
        assert addresses_of_listeners(pids_of(run)) == set()  # All have met.
        kill(gmi_pid(run, 3) or 0)
        wait(lambda: len(events(run, "recovered")) == 1, "it goes on without GMI 3")
        [fault] = events(run, "fault")
        assert fault["gmi"] == 3
        assert "SIGKILL" in fault["cause"]

        os.kill(cluster.second_raylet, signal.SIGKILL)
        wait(lambda: len(events(run, "recovered")) == 2, "it goes on without the second node")
        fault = events(run, "fault")[-1]
        # Which position it had depends on how Ray placed the actors of the second attempt.
        assert re.search(r"node [01] \(.*\) is gone", fault["cause"])
        wait(lambda: iteration_of(run, 1) > iteration_of(run, 3), "two GMIs train")
        assert json.loads((run / "plan.json").read_text())["layout"] == [[0, 1]]

        controller.send_signal(signal.SIGTERM)
        assert controller.wait(120) == 130, stderr.read_text()
        assert not pids_of(run)
        summary = json.loads((run / "summary.json").read_text())
        assert (summary["status"], len(summary["restarts"])) == ("interrupted", 2)

        # With a cluster of its own, which nobody else gets into, and which must end with it too.
        monkeypatch.setenv("HOME", str(tmp_path))
        controller = start(*job, "cluster.address=local", cwd=tmp_path)
        wait(lambda: iteration_of(run, 1) > 0, "it goes on from its checkpoint")
        # 127.0.0.1, also of sockets for both versions of IP.
        loopback = {"0100007F", "0000000000000000FFFF00000100007F"}
        assert addresses_of_listeners(family_of(controller.pid)) == loopback
        assert not (tmp_path / ".ray").exists()
        # Ray's own helpers take a minute more.
        started = [*pids_of(run), *children_of(controller.pid)]
        left = [process for pid in started if (process := identify(pid))]
        assert len(left) > 2
        kill(controller.pid)
        controller.wait()
        wait_until(lambda: not any(p.is_running() for p in left), 60, "all processes gone")
        require_gone(shared_memory, memory)
    finally:
        kill(controller.pid)
        controller.wait()
