"""A sweep with real processes on the CPU: a job that fails, a kill, and going on."""

from __future__ import annotations

import csv
import json
import signal
from pathlib import Path
from typing import Any

import pytest
from sweep_neighbours import Neighbours
from training_jobs import POINT, STEPS, start, train, wait_until

SWEEP = (
    *POINT,
    f"num_timesteps={40 * STEPS}",
    "run.checkpoint_every=10",
    "seed=0,1",
    # The larger one is infinite in float32, and so is the loss.
    "algo.entropy_cost=1e-3,1e39",
    "sweep.jobs_per_gpu=2",
    "run.dir=all",
)


def report(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "all" / "sweep.json").read_text())


def states(folder: Path) -> list[str]:
    return [job["state"] for job in report(folder)["jobs"]]


def table_states(folder: Path) -> list[str]:
    with (folder / "all" / "sweep.csv").open() as file:
        return [row["state"] for row in csv.DictReader(file)]


@pytest.mark.timeout(600)
def test_a_sweep_that_is_killed_goes_on_and_a_job_fails_alone(tmp_path: Path) -> None:
    first = start(*SWEEP, cwd=tmp_path, command="sweep")
    whole = tmp_path / "all" / "000" / "summary.json"

    def is_through() -> bool:
        told = tmp_path / "all" / "sweep.csv"  # Written after sweep.json.
        return first.poll() is not None or (
            told.exists() and table_states(tmp_path)[:1] == ["completed"]
        )

    wait_until(is_through, 250.0, "a job is through")
    first.send_signal(signal.SIGKILL)
    first.wait()
    # What it has left is true; only of jobs that ran then it cannot know that they run no more.
    killed = report(tmp_path)
    assert killed["status"] == "running"
    assert killed["jobs"][0]["env_steps"] == 40 * STEPS
    assert killed["jobs"][0]["value"] is not None
    when = whole.stat().st_mtime_ns

    done = train(*SWEEP, cwd=tmp_path, command="sweep", timeout_s=400.0)
    assert done.returncode == 1
    assert "2 of 4 jobs failed; job 1: " in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert states(tmp_path) == ["completed", "failed"] * 2
    assert whole.stat().st_mtime_ns == when  # It was not run again.
    found = report(tmp_path)
    assert sorted(found["ranking"]) == [0, 2]
    assert found["jobs"][1]["overrides"] == {"seed": "0", "algo.entropy_cost": "1e+39"}
    assert found["jobs"][0]["wall_s"] > 0.0
    assert table_states(tmp_path) == states(tmp_path)
    assert (tmp_path / "all" / "sweep.png").stat().st_size > 10_000

    other = train(*SWEEP, "seed=0,2", cwd=tmp_path, command="sweep")
    assert other.returncode == 2
    assert "holds another sweep; give the same lists, or another folder" in other.stderr


@pytest.mark.timeout(900)
def test_jobs_do_as_alone_beside_one_that_is_killed(tmp_path: Path) -> None:
    neighbours = Neighbours(tmp_path, *POINT, f"num_timesteps={400 * STEPS}")
    alone = neighbours.alone()
    assert len(alone) == 400
    states, lines = neighbours.beside_a_killed_job()
    assert states == ["completed", "completed", "failed", "completed"]
    assert lines == alone
