"""A run folder that is moved or removed while a real job writes into it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from training_jobs import FOREVER, POINT, STEPS, pids_of, start, train, wait_until

from gmijax.runs.resume import checkpoints_of


def moved(run: Path) -> None:
    run.rename(run.with_name("moved"))


@pytest.mark.timeout(300)
@pytest.mark.parametrize(("harm", "where"), [(moved, "was moved to"), (shutil.rmtree, "removed")])
def test_the_job_ends_and_makes_nothing_anew(
    tmp_path: Path, harm: Callable[[Path], object], where: str
) -> None:
    run = tmp_path / "a [1]"
    job = start(*POINT, FOREVER, "run.dir='a [1]'", "run.checkpoint_every=20", cwd=tmp_path)
    wait_until(lambda: checkpoints_of(run) or job.poll() is not None, 120, "a checkpoint")
    harm(run)
    assert job.wait(60) == 1
    said = (tmp_path / "stderr.txt").read_text()
    assert len(said.splitlines()) == 1, said
    assert said.startswith(f"gmijax.train: run.dir={run}: the folder was ")
    assert where in said
    assert not run.exists()
    wait_until(lambda: not pids_of(run), 60, "all GMIs gone")
    if harm is moved:  # What was there can be used.
        moved_to = tmp_path / "moved"
        steps = int(checkpoints_of(moved_to)[-1].name) + STEPS
        again = ("run.resume=moved", "run.dir=b", f"num_timesteps={steps}")
        done = train(*again, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
