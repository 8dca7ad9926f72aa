"""A folder that is moved or removed while a real job writes into it."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from training_jobs import FOREVER, POINT, POINT_TASK, STEPS, pids_of, start, train, wait_until

from gmijax.runs.checkpoints import checkpoints_of
from gmijax.runs.dataset import DataPaths


def moved(run: Path) -> None:
    run.rename(run.with_name("moved"))


def removed(run: Path) -> None:
    while run.exists():  # The job may write into it until all is gone.
        shutil.rmtree(run, ignore_errors=True)


@pytest.mark.timeout(300)
@pytest.mark.parametrize(("harm", "where"), [(moved, "moved to"), (removed, "removed")])
def test_the_job_ends_and_makes_nothing_anew(
    tmp_path: Path,
    harm: Callable[[Path], object],
    where: str,
    request: pytest.FixtureRequest,
) -> None:
    run = tmp_path / "a [1]"
    job = start(*POINT, FOREVER, "run.dir='a [1]'", "run.checkpoint_every=20", cwd=tmp_path)
    request.addfinalizer(job.kill)
    wait_until(lambda: checkpoints_of(run) or job.poll() is not None, 120, "a checkpoint")
    harm(run)
    require_end(job, tmp_path, f"gmijax.train: run.dir=a [1]: the folder was {where}")
    assert not run.exists()
    wait_until(lambda: not pids_of(run), 60, "all GMIs gone")
    if harm is moved:  # What was there can be used.
        moved_to = tmp_path / "moved"
        steps = int(checkpoints_of(moved_to)[-1].name) + STEPS
        again = ("run.resume=moved", "run.dir=b", f"num_timesteps={steps}")
        done = train(*again, cwd=tmp_path)
        assert done.returncode == 0, done.stderr


@pytest.mark.timeout(300)
def test_serving_ends_without_its_output_folder(tmp_path: Path) -> None:
    (tmp_path / "point.py").write_text(POINT_TASK)
    output = tmp_path / "out"
    job = start(
        *("env=point.py:make", "policy=random", "num_envs=16", "unroll_length=4"),
        *("latency_steps=20", "run.name=x", "output.dir=out", FOREVER),
        cwd=tmp_path,
        command="serve",
    )
    data = DataPaths(output)
    wait_until(lambda: data.num_finished(0) or job.poll() is not None, 120, "a shard")
    output.rename(tmp_path / "moved")
    require_end(job, tmp_path, "gmijax.serve: output.dir=out: the folder was moved to")
    assert not output.exists()


@pytest.mark.timeout(300)
def test_a_sweep_ends_without_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "all"
    job = start(
        *POINT, FOREVER, "run.checkpoint_every=20", "seed=0,1", "run.dir=all",
        cwd=tmp_path, command="sweep",
    )  # fmt: skip
    wait_until(lambda: checkpoints_of(folder / "000") or job.poll() is not None, 200, "a job")
    moved(folder)
    require_end(job, tmp_path, "gmijax.sweep: run.dir=all: the folder was moved to")
    assert not folder.exists()


def require_end(job: subprocess.Popen[bytes], cwd: Path, message: str) -> None:
    assert job.wait(90) == 1
    [line] = (cwd / "stderr.txt").read_text().splitlines()
    assert line.startswith(message)
