"""What commands leave, made once and copied for every case that needs it."""

from __future__ import annotations

import fcntl
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import numpy as np
from fault_commands import COMMANDS
from fault_jobs import run_job
from training_jobs import DRAWN_TASK, POINT, POINT_TASK, STEPS, child_environment, learner_arrays

RUN_STEPS: Final = 200 * STEPS
TRAIN: Final = (*POINT, "plan.gpus=1", "plan.backend=cpu", "run.checkpoint_every=40",
                "run.keep_checkpoints=null")  # fmt: skip
SWEEP: Final = (*TRAIN, f"num_timesteps={RUN_STEPS}", "seed=0,1", "sweep.jobs_per_gpu=2")
COLLECT: Final = ("env=point.py:make", "policy=random", "num_envs=16", "unroll_length=4",
                  "latency_steps=0")  # fmt: skip
SEARCH: Final = tuple(
    key.replace("[16,32]", "[16]")
    for key in COMMANDS["search"].overrides
    if not key.startswith(("search.store=", "run.dir="))
)

_MADE_BY: Final = {
    "run": ("train", (*TRAIN, f"num_timesteps={RUN_STEPS}", "run.dir=run")),
    "sweep": ("sweep", (*SWEEP, "run.dir=sweep")),
    "data": ("serve", (*COLLECT, "num_timesteps=256", "output.dir=data")),
    "store": ("search", (*SEARCH, "search.store=store", "run.dir=found")),
    "export": ("export", ("run.dir=run",)),
}


def fixture(name: str, home: Path) -> Path:
    """The folder `name` in `home`, which several processes may share; made if it is not there.

    `run` is of a training that is complete, `sweep` of a sweep, `data` of serving, `store` of a
    search; `export` has the files of a policy.
    """
    home.mkdir(parents=True, exist_ok=True)
    with (home / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (home / f"{name}.made").exists():
            _make(name, home)
            (home / f"{name}.made").touch()
    if name == "export":
        [exported] = (home / "run").glob("export/*")
        return exported
    return home / name


def write_tasks(home: Path) -> None:
    """The files of tasks that the commands name."""
    (home / "point.py").write_text(POINT_TASK)
    (home / "drawn.py").write_text(DRAWN_TASK)


def _make(name: str, home: Path) -> None:
    if name == "export" and not (home / "run.made").exists():
        _make("run", home)
        (home / "run.made").touch()
    write_tasks(home)
    for left in (name, "found"):
        if name != "export":  # Of a time when it could not be made.
            shutil.rmtree(home / left, ignore_errors=True)
    verb, overrides = _MADE_BY[name]
    done = subprocess.run(
        [sys.executable, "-m", f"gmijax.{verb}", *overrides],
        cwd=home,
        env=child_environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def undisturbed(home: Path) -> list[np.ndarray]:
    """What a training job of `fault_jobs` learns without faults."""
    home.mkdir(parents=True, exist_ok=True)
    with (home / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        run = home / "undisturbed"
        if not (run / "disk" / "run" / "summary.json").exists():
            report = run_job([], run, [])
            assert not report.leaks, report
    return learner_arrays(run / "disk" / "run")
