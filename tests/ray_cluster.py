"""Two nodes of Ray on this machine, in a process of their own, for process tests."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from training_jobs import child_environment

TWO_NODES = Path(__file__).parent / "two_ray_nodes.py"
RAY = "cluster.engine=ray"


class Cluster:
    """Two nodes of Ray.

    Attributes:
      address: as an override.
      second_raylet: process of the node that does not lead the cluster.
    """

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        self._process, self._log = process, log
        self._hear()

    def add_node(self) -> None:
        """Adds one in place of the second, which was killed."""
        assert self._process.stdin is not None
        self._process.stdin.write(b"add\n")
        self._process.stdin.flush()
        self._hear()

    def _hear(self) -> None:
        assert self._process.stdout is not None
        lines = (json.loads(line) for line in self._process.stdout if line.startswith(b"{"))
        said: dict[str, Any] | None = next(lines, None)
        assert said is not None, self._log.read_text()
        self.address = f"cluster.address={said['address']}"
        self.second_raylet: int = said["second_raylet"]


@contextmanager
def two_nodes(log: Path, gpus: Sequence[int] = ()) -> Iterator[Cluster]:
    """The nodes while it is entered, with one of these two GPUs each; `log` gets their errors."""
    with (
        log.open("wb") as stderr,
        subprocess.Popen(
            [sys.executable, str(TWO_NODES), *map(str, gpus)],
            env=child_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
        ) as process,
    ):
        yield Cluster(process, log)
        process.communicate(timeout=120)
