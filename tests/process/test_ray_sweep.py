"""A sweep over two nodes of Ray on this machine, one of which is killed."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
from pathlib import Path

import pytest
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

from benchmarks.two_ray_nodes import RAY, two_nodes
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


def is_below(pid: int, ancestor: int) -> bool:
    """Whether a process was started by another one, or by what that has started."""
    while pid not in (ancestor, 0):
        try:
            status = Path(f"/proc/{pid}/status").read_text()
        except OSError:
            return False
        pid = int(status.partition("PPid:")[2].split()[0])
    return pid == ancestor


def test_a_sweep_over_two_nodes_finishes_on_one_when_the_other_is_killed(tmp_path: Path) -> None:
    memory = shared_memory()
    folder, stderr = tmp_path / "all", tmp_path / "stderr.txt"
    runs = [folder / f"{job:03d}" for job in range(4)]

    def saved_by(raylet: int) -> bool:
        """Whether a job on its node has a checkpoint."""
        return any(
            any(run.glob("checkpoints/*/meta.json"))
            and any(is_below(pid, raylet) for pid in pids_of(run))
            for run in runs
        )

    with two_nodes(tmp_path / "nodes.txt") as cluster:
        sweep = start(*SWEEP, cluster.address, cwd=tmp_path, command="sweep")
        try:
            wait_until(
                lambda: saved_by(cluster.second_raylet) or sweep.poll() is not None,
                150,
                f"a job on the second node has a checkpoint: {stderr}",
            )
            os.kill(cluster.second_raylet, signal.SIGKILL)
            assert sweep.wait(150) == 0, stderr.read_text()
        finally:
            kill(sweep.pid)
            sweep.wait()

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
