"""Whether a job of a sweep does what it does alone, whatever becomes of those beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from training_jobs import gmi_pid, kill, start, train, wait_until

from gmijax.runs.history import read_metrics

_OF_TIME = ("time", "wall_s", "env_steps_per_s")


class Neighbours:
    """Sweeps of jobs that share all but the seed.

    Args:
      folder: for the sweeps.
      overrides: of every job; nothing is started again.
    """

    def __init__(self, folder: Path, *overrides: str) -> None:
        self._folder = folder
        own = "run.max_restarts=0", "run.checkpoint_every=0", "sweep.jobs_per_gpu=4"
        self._overrides = (*overrides, *own)

    def alone(self) -> list[dict[str, Any]]:
        """Lines of metrics of seed 0 with nobody beside it."""
        done = train(
            *self._overrides, "seed=0", "run.dir=alone", cwd=self._folder, command="sweep"
        )
        assert done.returncode == 0, done.stderr
        return self.lines("alone", 0)

    def beside_a_killed_job(self, num_jobs: int) -> tuple[list[str], list[dict[str, Any]]]:
        """States of jobs of which the second is killed, and the lines of the first."""
        seeds = ",".join(map(str, range(num_jobs)))
        command = (*self._overrides, f"seed={seeds}", "run.dir=killed")
        sweep = start(*command, cwd=self._folder, command="sweep")
        victim = self._folder / "killed" / "001"

        def pid() -> int | None:
            trains = sweep.poll() is None and len(read_metrics(victim / "metrics.jsonl")) > 2
            return gmi_pid(victim, 0) if trains else None

        kill(wait_until(pid, 300.0, "a job trains"))
        assert sweep.wait(timeout=500) == 1
        return self.states("killed"), self.lines("killed", 0)

    def beside_others(self, *more: str) -> tuple[list[str], list[dict[str, Any]]]:
        """States of jobs that `more` makes many, and the lines of the first."""
        command = (*self._overrides, *more, "run.dir=others")
        train(*command, cwd=self._folder, command="sweep", timeout_s=500.0)
        return self.states("others"), self.lines("others", 0)

    def states(self, name: str) -> list[str]:
        """Of the jobs of a sweep."""
        report = json.loads((self._folder / name / "sweep.json").read_text())
        return [job["state"] for job in report["jobs"]]

    def lines(self, name: str, job: int) -> list[dict[str, Any]]:
        """Of the metrics of a job, without those that are times."""
        found = read_metrics(self._folder / name / f"{job:03d}" / "metrics.jsonl")
        return [
            {key: value for key, value in line.items() if not key.startswith(_OF_TIME)}
            for line in found
        ]
