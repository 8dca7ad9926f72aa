"""What programs read of jobs: every start and every end, however short a job is."""

from __future__ import annotations

import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from gmijax.sweeps.events import JobEvents
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.progress import Progress


def events_of(progress: Progress, *changes: dict[str, Any]) -> list[tuple[str, Any]]:
    """Names of the events with the attempt, where there is one; each change is seen once."""
    stream = io.StringIO()
    job: Any = SimpleNamespace(number=0, overrides={}, num_timesteps=None, progress=progress)
    events = JobEvents(stream, "pack", [job], SweepPaths(Path("all")))
    for change in changes:
        for name, value in change.items():
            setattr(progress, name, value)
        events.update()
    written = map(json.loads, stream.getvalue().splitlines())
    return [(event["event"], event.get("attempt")) for event in written][1:]


def test_a_job_that_ended_before_anybody_looked_has_started():
    short = events_of(Progress(), {"state": "completed", "attempts": 1})
    assert short == [("job_started", 1), ("job_ended", None)]
    failed = events_of(Progress(), {"state": "failed", "attempts": 1}, {})
    assert failed == [("job_started", 1), ("job_ended", None)]


def test_a_job_starts_once_in_each_attempt():
    running = {"state": "running", "attempts": 1}
    again = {"state": "running", "attempts": 2}
    waits = {"state": "waiting", "note": "no slot is free"}
    assert events_of(Progress(), running, {}, waits, again, {"state": "completed"}) == [
        ("job_started", 1),
        ("job_waits", None),
        ("job_started", 2),
        ("job_ended", None),
    ]
    # Both attempts were over before anybody looked.
    assert events_of(Progress(), running, {"state": "failed", "attempts": 2}) == [
        ("job_started", 1),
        ("job_started", 2),
        ("job_ended", None),
    ]


def test_the_end_counts_the_jobs_and_names_those_that_failed():
    stream = io.StringIO()
    jobs: list[Any] = [
        SimpleNamespace(number=number, overrides={}, num_timesteps=None, progress=Progress())
        for number in range(4)
    ]
    events = JobEvents(stream, "pack", jobs, SweepPaths(Path("all")))
    for job, state in zip(jobs, ("completed", "failed", "completed", "failed"), strict=True):
        job.progress.state = state
    events.end({"status": "failed"})
    last = json.loads(stream.getvalue().splitlines()[-1])
    assert (last["event"], last["status"]) == ("pack_ended", "failed")
    assert (last["jobs"], last["failed"]) == ({"completed": 2, "failed": 2}, [1, 3])


def test_a_job_that_was_never_started_ends_without_a_start():
    assert events_of(Progress(), {"state": "interrupted"}) == [("job_ended", None)]
