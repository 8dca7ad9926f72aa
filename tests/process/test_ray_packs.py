"""A pack over two nodes of Ray on this machine, one of which is killed."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import sys
from pathlib import Path

import pytest
from training_jobs import kill, pids_of, require_gone, shared_memory, start, wait_until

from benchmarks.two_ray_nodes import RAY, two_nodes

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed"),
    pytest.mark.timeout(400),
]

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


def test_a_pack_over_two_nodes_finishes_on_one_when_the_other_is_killed(tmp_path: Path) -> None:
    memory = shared_memory()
    folder, errors = tmp_path / "all", tmp_path / "stderr.txt"
    (tmp_path / "trainer.py").write_text(TRAINER)
    command = ("--", sys.executable, "trainer.py", "{seed}", "{steps}", "{run_dir}")

    def have_reported() -> bool:
        """Whether both of the first jobs have."""
        return all((folder / name / "pack/metrics.jsonl").exists() for name in ("000", "001"))

    with two_nodes(tmp_path / "nodes.txt") as cluster:
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
