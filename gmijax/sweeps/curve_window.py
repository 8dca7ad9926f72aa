"""How fast jobs train at the same time: their steps while all of them do."""

from __future__ import annotations

from collections.abc import Sequence

from gmijax.clock import running_s
from gmijax.sweeps.jobs import Job

_WINDOW_S = 4.0
_LEAST_ITERATIONS = 6


class CurveWindow:
    """Steps of jobs while all of them train.

    Attributes:
      steps_per_s: of all together; None where they did not come so far.
      iteration_s: seconds of an iteration of the first job.
    """

    def __init__(self, jobs: Sequence[Job], limit_s: float) -> None:
        self._jobs = jobs
        self._deadline_s = running_s() + limit_s
        self._seen = [{0} for _ in jobs]
        self._start: tuple[float, list[int]] | None = None
        self.steps_per_s: float | None = None
        self.iteration_s = 0.0

    def is_over(self) -> bool:
        """Looks at the jobs; whether enough was seen, or one has failed, or it takes too long."""
        now_s = running_s()
        steps = [job.progress.env_steps for job in self._jobs]
        for seen, own in zip(self._seen, steps, strict=True):
            seen.add(own)
        # The first iterations of some fall into the compilation of others.
        if self._start is None and min(map(len, self._seen)) > 2:
            self._start = now_s, steps
            self._seen = [{own} for own in steps]
        if self._start is not None and min(map(len, self._seen)) > _LEAST_ITERATIONS:
            started_s, before = self._start
            if now_s - started_s >= _WINDOW_S:
                self.steps_per_s = (sum(steps) - sum(before)) / (now_s - started_s)
                self.iteration_s = (now_s - started_s) / (len(self._seen[0]) - 1)
                return True
        has_failed = any(job.progress.state == "failed" for job in self._jobs)
        return has_failed or now_s > self._deadline_s
