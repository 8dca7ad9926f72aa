"""A sweep with real processes on the CPU: a job that fails, a kill, and going on."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from command_lines import run as run_here
from small_disk import can_mount, small_disk
from sweep_neighbours import Neighbours
from training_jobs import FOREVER, POINT, STEPS, start, train, wait_until

from gmijax.runs.checkpoints import newest_checkpoint

SWEEP = (
    *POINT,
    f"num_timesteps={40 * STEPS}",
    "run.checkpoint_every=10",
    # The second one is infinite in float32, and so is the loss.
    "algo.entropy_cost=1e-3,1e39,1e-2",
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
        table = tmp_path / "all" / "sweep.csv"  # Written after sweep.json.
        return first.poll() is not None or (
            table.exists() and table_states(tmp_path)[:1] == ["completed"]
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
    assert "1 of 3 jobs failed; job 1: " in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert states(tmp_path) == ["completed", "failed", "completed"]
    assert whole.stat().st_mtime_ns == when  # It was not run again.
    found = report(tmp_path)
    assert sorted(found["ranking"]) == [0, 2]
    assert found["jobs"][1]["overrides"] == {"algo.entropy_cost": "1e+39"}
    assert found["jobs"][0]["wall_s"] > 0.0
    assert table_states(tmp_path) == states(tmp_path)
    assert (tmp_path / "all" / "sweep.png").stat().st_size > 10_000

    other = run_here("sweep", *SWEEP, "seed=0,2", cwd=tmp_path)
    assert other.code == 2
    assert "holds another sweep; give the same lists, or another folder" in other.stderr


@pytest.mark.timeout(400)
def test_a_job_whose_controller_is_killed_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    # The second one is interrupted as if by somebody who takes it for a run of its own.
    left = {0: signal.SIGKILL, 1: signal.SIGTERM}
    command = (*POINT, f"num_timesteps={1000 * STEPS}", "run.checkpoint_every=100", "seed=0,1")
    sweep = start(
        *command,
        *("run.max_restarts=2", "sweep.jobs_per_gpu=2", "run.dir=all"),
        cwd=tmp_path,
        command="sweep",
    )
    runs = [tmp_path / "all" / name for name in ("000", "001")]

    def are_sent() -> bool:
        # Each at its own first checkpoint: the other one may be through by then.
        for number in [number for number in left if newest_checkpoint(runs[number]).checkpoint]:
            job = tmp_path / "all" / "jobs" / f"{number:03d}.json"
            os.kill(controller_of(job), left.pop(number))
        return sweep.poll() is not None or not left

    wait_until(are_sent, 200.0, "a checkpoint of each")
    assert sweep.wait(timeout=300) == 0, (tmp_path / "stderr.txt").read_text()
    assert states(tmp_path) == ["completed"] * 2
    reasons = "its controller was killed by SIGKILL", "a signal from elsewhere interrupted it"
    for run, why in zip(runs, reasons, strict=True):
        events = [json.loads(line) for line in (run / "events.jsonl").read_text().splitlines()]
        assert [e["reason"] for e in events if e["event"] == "again"] == [f"again, after {why}"]
        assert [e["checkpoint"] is not None for e in events if e["event"] == "start"][-1]
    out = (tmp_path / "stdout.txt").read_text()
    assert "2 jobs, 2 at a time on the CPU" in out
    # Both seeds are one setting, and it comes first.
    assert out.index(", mean  ") < out.index("overrides")
    for name in ("sweep.json", "settings.csv", "sweep.csv", "sweep.png"):
        assert f" all/{name}" in "".join(out.split("\n")[-9:])
    assert re.search(r"\n  gmijax play run\.dir=all/00[01]\n$", out)


@pytest.mark.timeout(400)
def test_a_misspelt_objective_ends_a_sweep_soon_and_the_mended_command_goes_on(
    tmp_path: Path,
) -> None:
    command = (*POINT, f"num_timesteps={40 * STEPS}", "seed=0,1", "run.dir=all")
    wrong = ("sweep.objective=metric/distnace", FOREVER)
    refused = train(*command, *wrong, cwd=tmp_path, command="sweep")
    assert refused.returncode == 2
    (line,) = refused.stderr.splitlines()
    assert line.startswith(
        "gmijax.sweep: sweep.objective=metric/distnace: not in the metrics of these jobs: did you "
        "mean metric/distance?; to continue: the command with that mended and run.dir=all"
    )
    assert report(tmp_path)["status"] == "failed"
    assert states(tmp_path) == ["interrupted", "waiting"]
    done = train(*command, "sweep.objective=metric/distance", cwd=tmp_path, command="sweep")
    assert done.returncode == 0, done.stderr
    assert len(report(tmp_path)["ranking"]) == 2


def controller_of(order: Path) -> int:
    """The process of a job of a sweep."""
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if str(order).encode() in (folder / "cmdline").read_bytes().split(b"\0"):
                return int(folder.name)
    raise AssertionError(f"no process has {order}")


@pytest.mark.timeout(400)
@pytest.mark.skipif(not can_mount(), reason="may not mount a small disk")
def test_a_full_disk_ends_a_sweep_in_one_line_and_its_report_says_so(tmp_path: Path) -> None:
    (tmp_path / "all").mkdir()
    command = (*POINT, FOREVER, "seed=0,1", "run.checkpoint_every=50", "run.keep_checkpoints=1")
    command = (*command, "sweep.jobs_per_gpu=2", "run.dir=all")
    with small_disk(tmp_path / "all"):
        sweep = start(*command, cwd=tmp_path, command="sweep")
        runs = [tmp_path / "all" / name for name in ("000", "001")]

        def are_saved() -> bool:
            return sweep.poll() is not None or all(
                newest_checkpoint(run).checkpoint for run in runs
            )

        wait_until(are_saved, 200.0, "a checkpoint of each")
        with suppress(OSError), (tmp_path / "all" / "filler").open("wb", buffering=0) as filler:
            while True:
                filler.write(bytes(1024))
        assert sweep.wait(timeout=200) == 1
        (line,) = (tmp_path / "stderr.txt").read_text().splitlines()
        assert "No space left on device" in line or "disk is full" in line
        assert report(tmp_path)["status"] == "failed"
        assert states(tmp_path) == ["failed"] * 2
        assert table_states(tmp_path) == ["failed"] * 2
        (tmp_path / "all" / "filler").unlink()
        # The same command goes on.
        again = start(*command, cwd=tmp_path, command="sweep")
        saved = [newest_checkpoint(run).checkpoint for run in runs]

        def has_gone_on() -> bool:
            newest = [newest_checkpoint(run).checkpoint for run in runs]
            return again.poll() is not None or all(
                one != old for one, old in zip(newest, saved, strict=True)
            )

        wait_until(has_gone_on, 200.0, "another checkpoint of each")
        again.send_signal(signal.SIGINT)
        assert again.wait(timeout=100) == 130
        assert states(tmp_path) == ["interrupted"] * 2


@pytest.mark.timeout(900)
def test_jobs_do_as_alone_beside_one_that_is_killed(tmp_path: Path) -> None:
    neighbours = Neighbours(tmp_path, *POINT, f"num_timesteps={400 * STEPS}")
    alone = neighbours.alone()
    assert len(alone) == 400
    states, lines = neighbours.beside_a_killed_job(2)
    assert states == ["completed", "failed"]
    assert lines == alone
