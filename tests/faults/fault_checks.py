"""What must be true of a command that has ended, whatever happened to it.

Nothing here asks the package which checkpoints are whole: it is what is tried.
"""

from __future__ import annotations

import json
import os
import re
import stat
import time
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from fault_plan import ITERATIONS
from training_jobs import STEPS, mps_directories, shared_memory

_OTHERS_S = 10.0
"""Names in shared places that appeared may be those of other programs, which end."""

_NAME = re.compile(r"[0-9]{12}", re.ASCII)


def before() -> tuple[set[str], set[str]]:
    """What others have in places that all processes share."""
    return shared_memory(), mps_directories()


def left_in_shared_places(start: tuple[set[str], set[str]], scratch: Path) -> list[str]:
    """Names that were not there before; sockets end with processes."""
    deadline_s = time.monotonic() + _OTHERS_S
    while (more := _new_names(start)) and time.monotonic() < deadline_s:
        time.sleep(0.1)
    left = [f"leaked: {name} in a shared place" for name in more]
    return left + [f"leaked: {path}" for path in (scratch / "tmp").glob("gmijax*")]


def left_in_folder(run: Path) -> list[str]:
    """Files that only lie there while something is written."""
    hidden = (path for path in run.rglob(".*") if path.name != ".lock")
    return [f"leaked: {path.relative_to(run)} in the run folder" for path in hidden]


def _new_names(start: tuple[set[str], set[str]]) -> set[str]:
    return set().union(*(now - old for now, old in zip(before(), start, strict=True)))


def checkpoints_of(run: Path) -> list[Path]:
    """The folders that are called as checkpoints are and are complete, oldest first."""
    found = (meta.parent for meta in run.glob("checkpoints/*/meta.json"))
    return sorted(path for path in found if _NAME.fullmatch(path.name))


def newest_whole(run: Path) -> Path | None:
    """The newest checkpoint whose files are as they were written."""
    return next((path for path in reversed(checkpoints_of(run)) if is_whole(path)), None)


def is_whole(checkpoint: Path) -> bool:
    """Whether the files of a checkpoint have the sizes and sums that were noted."""
    try:
        noted = json.loads((checkpoint / "meta.json").read_text())["files"]
        return bool(noted) and all(_sum(checkpoint / name) == tuple(noted[name]) for name in noted)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return False


def _sum(path: Path) -> tuple[int, int]:
    if not stat.S_ISREG(path.lstat().st_mode):
        raise OSError("not a file")
    data = path.read_bytes()
    return len(data), zlib.crc32(data)


def events_of(run: Path, event: str | None = None) -> list[dict[str, Any]]:
    """Events of a run, of one kind or all; what is half written is none."""
    found: list[dict[str, Any]] = []
    with suppress(OSError):
        for line in (run / "events.jsonl").read_text().splitlines():
            with suppress(ValueError):
                found.append(json.loads(line))
    return [line for line in found if event is None or line.get("event") == event]


def not_one_line(stderr: str, verb: str) -> list[str]:
    """What is wrong with the errors of a command that failed: they are one line."""
    lines = stderr.splitlines()
    if len(lines) == 1 and lines[0].startswith(f"gmijax.{verb}: "):
        return []
    return [f"not one line of gmijax.{verb}: {stderr[-600:]}"]


def what_is_wrong(run: Path) -> list[str]:
    """What a training job of `fault_jobs` that is complete says that is not so."""
    return list(_wrong(run))


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
    last = newest_whole(run)
    if last is None or int(last.name) != ITERATIONS * 2 * STEPS:
        yield f"the last whole checkpoint is {last}"
    for path in checkpoints_of(run):
        if not is_whole(path):
            yield f"checkpoint {path.name} is not whole"
    if not os.listdir(run / "tensorboard"):
        yield "no events for TensorBoard"
