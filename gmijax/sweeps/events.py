"""What programs read of jobs that run: one JSON object a line."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final, TextIO

from gmijax.sweeps.any_job import AnyJob
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.progress import Progress

_PROGRESS_S: Final = 1.0
_ENDS: Final = ("completed", "failed", "pruned", "interrupted")


class JobEvents:
    """Prints events of jobs: `job_started`, `progress`, `job_ended`, and one at the end.

    Keys are only ever added. A number that is not known is null.

    Args:
      stream: gets a line for each event, as long as it is read; None: there is no reader.
      name: of the command, e.g. `pack`.
      jobs: those that are known; more may be added to the list.
      paths: their files.
    """

    def __init__(
        self, stream: TextIO | None, name: str, jobs: Sequence[AnyJob], paths: SweepPaths
    ) -> None:
        self._stream, self._name = stream, name
        self._jobs, self._paths = jobs, paths
        self._stages: dict[int, tuple[str, int, str | None]] = {
            job.number: (job.progress.state, 0, None) for job in jobs
        }
        self._reported_s = 0.0
        self._reports: dict[int, int] = {}
        self._write(f"{name}_started", run_dir=str(paths.root), jobs=len(jobs))

    def update(self) -> None:
        """Called about ten times a second."""
        if self._stream is None:
            return
        now_s = time.monotonic()
        is_due = now_s - self._reported_s >= _PROGRESS_S
        for job in self._jobs:
            now = job.progress.stage
            before = self._stages.get(job.number, ("waiting", 0, None))
            self._stages[job.number] = now
            if now != before:
                if now[0] == "running" or now[1] > before[1]:  # It may have ended since.
                    self._started(job)
                if now[0] != "running":
                    self._stopped(job, now[0])
            elif is_due and now[0] == "running":
                self._progress(job)
        if is_due:
            self._reported_s = now_s

    def end(self, report: Mapping[str, Any]) -> None:
        """After the last job."""
        self.update()
        found = {key: report.get(key) for key in ("status", "ranking", "settings", "wall_s")}
        states = [job.progress.state for job in self._jobs]
        failed = [job.number for job in self._jobs if job.progress.state == "failed"]
        # By state, and by number those that the user may have to fix.
        found |= {"jobs": dict(Counter(states)), "failed": failed}
        self._write(f"{self._name}_ended", **found)

    def _started(self, job: AnyJob) -> None:
        slot = job.progress.slot or None
        more = {"attempt": job.progress.attempts, "note": job.progress.note}
        self._write("job_started", job, overrides=dict(job.overrides), slot=slot, **more)

    def _stopped(self, job: AnyJob, state: str) -> None:
        progress = job.progress
        event = "job_ended" if state in _ENDS else "job_waits"
        error, log = progress.error, str(self._paths.log(job.number))
        ends = {"exit_code": progress.exit_code, "error": error, "log": log}
        if event == "job_waits":
            ends["note"] = progress.note
        self._write(event, job, state=state, **ends, **_figures(progress))

    def _progress(self, job: AnyJob) -> None:
        if self._reports.get(job.number) != job.progress.reports:
            self._reports[job.number] = job.progress.reports
            total = job.num_timesteps
            self._write("progress", job, num_timesteps=total, **_figures(job.progress))

    def _write(self, event: str, job: AnyJob | None = None, **more: Any) -> None:
        number = {} if job is None else {"job": job.number}
        line = json.dumps({"event": event, "time_s": round(time.time(), 3), **number, **more})
        if self._stream is None:
            return
        try:
            self._stream.write(f"{line}\n")
            self._stream.flush()
        except (OSError, ValueError):  # The reader is gone; the jobs continue.
            self._stream = None


def _figures(progress: Progress) -> dict[str, Any]:
    return {
        "env_steps": progress.env_steps,
        "env_steps_per_s": progress.env_steps_per_s or progress.mean_steps_per_s,
        "value": progress.value,
    }
