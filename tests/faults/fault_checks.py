"""What must be true of a job that has ended, whatever happened to it."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

from fault_plan import ITERATIONS
from training_jobs import STEPS, mps_directories, shared_memory, wait_until

from gmijax.runs.resume import newest_checkpoint, what_is_broken

_OTHERS_S = 10.0
"""Names in shared places that appeared may be those of other programs, which end."""


def before() -> tuple[set[str], set[str]]:
    """What others have in places that all processes share."""
    return shared_memory(), mps_directories()


def processes_of(scratch: Path) -> list[int]:
    """Processes that the job has started: controllers, GMIs, janitors; no zombies."""
    marker = f"GMIJAX_FAULTS={scratch}".encode()
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if marker in (entry / "environ").read_bytes().split(b"\0"):
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def what_is_left(
    start: tuple[set[str], set[str]], run: Path, scratch: Path, limit_s: float
) -> list[str]:
    """Processes, and names in shared places and in the run folder; sockets end with processes."""
    left = []
    try:
        wait_until(lambda: not processes_of(scratch), limit_s, "processes gone")
    except AssertionError:
        left.append(f"processes {processes_of(scratch)}")
    deadline_s = time.monotonic() + _OTHERS_S
    while (more := _new_names(start)) and time.monotonic() < deadline_s:
        time.sleep(0.1)
    left += [f"left in a shared place: {name}" for name in more]
    left += [f"left in the temporary folder: {path}" for path in (scratch / "tmp").glob("gmijax*")]
    hidden = (path for path in run.rglob(".*") if path != run / ".lock")
    return left + [f"left in the run folder: {path.relative_to(run)}" for path in hidden]


def what_is_wrong(run: Path) -> list[str]:
    """What a complete run says that is not so."""
    return list(_wrong(run))


def _new_names(start: tuple[set[str], set[str]]) -> set[str]:
    return set().union(*(now - old for now, old in zip(before(), start, strict=True)))


def _wrong(run: Path) -> Iterator[str]:
    status = json.loads((run / "summary.json").read_text())["status"]
    if status != "completed":
        yield f"summary.json says {status}"
    for name in ("events.jsonl", "metrics.jsonl"):
        for number, line in enumerate((run / name).read_text().splitlines(), 1):
            try:
                json.loads(line)
            except ValueError:
                yield f"{name}, line {number}: {line!r}"
    lines = (run / "metrics.jsonl").read_text().splitlines()
    steps = [json.loads(line)["env_steps"] for line in lines]
    if steps != [number * 2 * STEPS for number in range(1, ITERATIONS + 1)]:
        yield f"metrics.jsonl has the steps {steps}"
    last = newest_checkpoint(run).checkpoint
    if last is None or int(last.name) != ITERATIONS * 2 * STEPS:
        yield f"the last whole checkpoint is {last}"
    for path in sorted((run / "checkpoints").iterdir()):
        if broken := what_is_broken(path):
            yield f"checkpoint {path.name}: {broken}"
    if not os.listdir(run / "tensorboard"):
        yield "no events for TensorBoard"
