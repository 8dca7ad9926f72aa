"""A sweep and a pack over two nodes of Ray on this machine, one of which is killed."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from ray_cluster import RAY, Cluster, two_nodes
from training_jobs import (
    POINT,
    STEPS,
    events,
    kill,
    pids_of,
    require_gone,
    shared_memory,
    start,
    wait_until,
)

from gmijax.runs.history import read_metrics

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed"),
    pytest.mark.timeout(400),
]

LONG, SHORT = 600 * STEPS, 5 * STEPS
SWEEP = (
    *(*POINT, RAY, "cluster.nodes=2", "sweep.jobs_per_gpu=1", "run.dir=all"),
    # The long ones are the first two, one on each node.
    *(f"num_timesteps={LONG},{SHORT}", "seed=range(2)"),
    *("run.checkpoint_every=100", "run.max_restarts=3"),
)

TRAINER = """
import os, sys, time

number, steps, folder = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
with open(f"{folder}/starts", "a") as starts:
    print(os.getpid(), file=starts)
for step in range(1, steps + 1):
    time.sleep(0.01 if os.path.exists("finish") else 0.1)
    print(f"|    ep_rew_mean     | {number + step:.3g} |")
    print(f"|    total_timesteps | {step * 512} |", flush=True)
"""
# The long ones are the first two, one on each node.
PACK = (
    *(RAY, "cluster.nodes=2", "pack.jobs_per_gpu=1", "run.dir=all", "steps=300,20", "seed=0,1"),
    *("pack.max_restarts=2",),
)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with two_nodes(tmp_path_factory.mktemp("ray") / "stderr.txt") as nodes:
        yield nodes


def is_below(pid: int, ancestor: int) -> bool:
    """Whether a process was started by another one, or by what that has started."""
    while pid not in (ancestor, 0):
        try:
            status = Path(f"/proc/{pid}/status").read_text()
        except OSError:
            return False
        pid = int(status.partition("PPid:")[2].split()[0])
    return pid == ancestor


def test_a_sweep_over_two_nodes_finishes_on_one_when_the_other_is_killed(
    cluster: Cluster, tmp_path: Path
) -> None:
    memory = shared_memory()
    folder, said = tmp_path / "all", tmp_path / "stderr.txt"
    runs = [folder / f"{job:03d}" for job in range(4)]

    def saved_by(raylet: int) -> bool:
        """Whether a job on its node has a checkpoint."""
        return any(
            any(run.glob("checkpoints/*/meta.json"))
            and any(is_below(pid, raylet) for pid in pids_of(run))
            for run in runs
        )

    sweep = start(*SWEEP, cluster.address, cwd=tmp_path, command="sweep")
    try:
        wait_until(
            lambda: saved_by(cluster.second_raylet) or sweep.poll() is not None,
            150,
            f"a job on the second node has a checkpoint: {said}",
        )
        os.kill(cluster.second_raylet, signal.SIGKILL)
        assert sweep.wait(150) == 0, said.read_text()
    finally:
        kill(sweep.pid)
        sweep.wait()
        cluster.add_node()

    rows = json.loads((folder / "sweep.json").read_text())["jobs"]
    assert [row["state"] for row in rows] == ["completed"] * 4
    assert [row["env_steps"] for row in rows] == [LONG] * 2 + [SHORT] * 2
    again = {
        row["node"]: found
        for row, run in zip(rows, runs, strict=True)
        if (found := events(run, "again"))
    }
    [node] = again  # Those of the node that was killed ran on the other one.
    assert {row["node"] for row in rows[2:]} == {node}
    for found in again.values():
        assert re.search(r"again, after node [01] \(.*\) is gone", found[0]["reason"])
    for run in runs:  # From a checkpoint, with one curve.
        steps = [line["env_steps"] for line in read_metrics(run / "metrics.jsonl")]
        assert steps == sorted(set(steps))
    assert not any(pids_of(run) for run in runs)
    require_gone(shared_memory, memory)


def test_a_pack_over_two_nodes_finishes_on_one_when_the_other_is_killed(
    cluster: Cluster, tmp_path: Path
) -> None:
    memory = shared_memory()
    folder, errors = tmp_path / "all", tmp_path / "stderr.txt"
    (tmp_path / "trainer.py").write_text(TRAINER)
    command = ("--", sys.executable, "trainer.py", "{seed}", "{steps}", "{run_dir}")

    def have_reported() -> bool:
        """Whether both of the first jobs have."""
        return all((folder / name / "pack/metrics.jsonl").exists() for name in ("000", "001"))

    pack = start(*PACK, cluster.address, *command, cwd=tmp_path, command="pack")
    try:
        wait_until(
            lambda: have_reported() or pack.poll() is not None, 150, f"both report: {errors}"
        )
        os.kill(cluster.second_raylet, signal.SIGKILL)
        (tmp_path / "finish").touch()
        assert pack.wait(200) == 0, errors.read_text()
    finally:
        kill(pack.pid)
        pack.wait()

    rows = json.loads((folder / "pack.json").read_text())["jobs"]
    assert [row["state"] for row in rows] == ["completed"] * 4
    starts = [len((folder / f"{job:03d}/starts").read_text().split()) for job in range(4)]
    assert sorted(starts[:2]) == [1, 2]  # That of the node that was killed ran on the other one.
    assert starts[2:] == [1, 1]
    assert len({row["node"] for row in rows[2:]}) == 1
    assert [row["env_steps"] for row in rows] == [300 * 512] * 2 + [20 * 512] * 2
    assert not pids_of(folder)
    require_gone(shared_memory, memory)
