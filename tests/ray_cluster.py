"""Two nodes of Ray on this machine, in a process of their own, for process tests."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from training_jobs import child_environment

TWO_NODES = Path(__file__).parent / "two_ray_nodes.py"
RAY = "cluster.engine=ray"


class Cluster(NamedTuple):
    """Two nodes of Ray."""

    address: str  # As an override.
    second_raylet: int  # Process of the node that does not lead the cluster.


@contextmanager
def two_nodes(log: Path) -> Iterator[Cluster]:
    """The nodes while it is entered; `log` gets their errors."""
    with (
        log.open("wb") as stderr,
        subprocess.Popen(
            [sys.executable, str(TWO_NODES)],
            env=child_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
        ) as process,
    ):
        assert process.stdout is not None
        lines = (json.loads(line) for line in process.stdout if line.startswith(b"{"))
        said: dict[str, Any] | None = next(lines, None)
        assert said is not None, log.read_text()
        yield Cluster(f"cluster.address={said['address']}", said["second_raylet"])
        process.communicate(timeout=120)


def events(run: Path, event: str) -> list[dict[str, Any]]:
    path = run / "events.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    return [found for line in lines if (found := json.loads(line))["event"] == event]
