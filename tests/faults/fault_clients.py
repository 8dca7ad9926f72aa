"""Unauthenticated clients at the ports of a job on two nodes: slow, silent, many, with any bytes.

Their kinds and their group are `strangers` in files of results.
"""

from __future__ import annotations

import importlib.util
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

from fault_checks import events_of, left_in_folder
from fault_commands import COMMANDS, steps_saved
from fault_fixtures import write_tasks
from fault_processes import MARKER, processes_of, send
from fault_report import Report
from training_jobs import child_environment, kill, pids_of, wait_until

from benchmarks.two_ray_nodes import RAY, two_nodes

_LIMIT_S = 150.0
_ATTACK_S = 20.0
_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01"
_WAYS: dict[str, tuple[bytes, float]] = {
    "bytes of a random length": (b"", 0.0),
    "a greeting without a secret": (_GREETING + b"CURVE" + bytes(47), 1.0),
    "a greeting of another kind": (_GREETING + b"NULL" + bytes(48), 1.0),
    "an endless frame": (_GREETING + b"CURVE" + bytes(47) + b"\x06" + b"\x7f" * 8, 0.0),
    "silence": (b"", 3.0),
    "half a message": (b"\0", 30.0),
}
"""What a client sends, and how long it stays."""


@cache
def can_cluster() -> bool:
    """Whether Ray is installed."""
    return importlib.util.find_spec("ray") is not None


def run_with_clients(kind: str, seed: int, scratch: Path) -> Report:
    """Clients from the first port on; the job must start, train, and end when it is asked to."""
    wrong: list[str] = []
    scratch.mkdir(parents=True, exist_ok=True)
    write_tasks(scratch)
    (scratch / "tmp").mkdir()
    try:
        with two_nodes(scratch / "ray.txt") as cluster:
            wrong = _DisturbedJob(kind, seed, scratch, cluster.address).run()
    except Exception as error:
        wrong = [f"{type(error).__name__}: {error}"]
    left = processes_of(scratch)
    send(left, signal.SIGKILL)
    return Report.of(kind, seed, [*wrong, *(f"leaked: {process}" for process in left)])


class _DisturbedJob:
    def __init__(self, kind: str, seed: int, scratch: Path, address: str) -> None:
        self._draw = random.Random(seed)
        self._run = scratch / "run"
        self._log = scratch / "stderr_0.txt"
        command = COMMANDS["a3c" if kind == "strangers_registers" else "train"]
        keys = [key.format(run=self._run) for key in command.overrides if "plan.gpus" not in key]
        nodes = ("plan.gpus=1", RAY, address, "cluster.nodes=2")
        with self._log.open("wb") as log:
            self._job = subprocess.Popen(
                [sys.executable, "-m", "gmijax.train", *keys, *nodes],
                cwd=scratch,
                env=child_environment() | {MARKER: str(scratch), "TMPDIR": str(scratch / "tmp")},
                stdout=subprocess.DEVNULL,
                stderr=log,
            )
        self._is_over = threading.Event()
        self._visited: set[int] = set()

    def run(self) -> list[str]:
        visitors = threading.Thread(target=self._visit_all, daemon=True)
        visitors.start()
        try:
            self._wait(lambda: steps_saved(self._run) > 0, "it trains")
            time.sleep(_ATTACK_S)
            self._is_over.set()
            trained = steps_saved(self._run)
            self._wait(lambda: steps_saved(self._run) > trained, "it trains on")
            faults = events_of(self._run, "fault")
            self._job.send_signal(signal.SIGTERM)
            code = self._job.wait(_LIMIT_S)
        finally:
            self._is_over.set()
            kill(self._job.pid)
            self._job.wait()
        wrong = [f"there were faults: {faults}"] if faults else []
        wrong += [] if self._visited else ["no port was found"]
        if code != 130 or "did not finish" in self._log.read_text():
            wrong.append(f"exit code {code}: {self._log.read_text()[-600:]}")
        wrong += [f"leaked: process {pid}" for pid in pids_of(self._run)]
        return [*wrong, *left_in_folder(self._run)]

    def _wait(self, condition: Callable[[], bool], what: str) -> None:
        wait_until(lambda: condition() or self._job.poll() is not None, _LIMIT_S, what)
        assert self._job.poll() is None, self._log.read_text()[-600:]

    def _visit_all(self) -> None:
        """Clients of every kind at every port, from the moment that it is there."""
        while not self._is_over.wait(0.05):
            for port in _ports(pids_of(self._run)) - self._visited:
                self._visited.add(port)
                for way in _WAYS.values():
                    seed = self._draw.randrange(2**32)
                    threading.Thread(
                        target=self._visit, args=(port, *way, random.Random(seed)), daemon=True
                    ).start()

    def _visit(self, port: int, data: bytes, stay_s: float, draw: random.Random) -> None:
        while not self._is_over.is_set():
            try:
                with socket.create_connection(("127.0.0.1", port), 2.0) as client:
                    client.sendall(data or draw.randbytes(draw.randrange(1, 3000)))
                    self._is_over.wait(stay_s)
            except OSError:
                self._is_over.wait(0.2)


def _ports(pids: list[int]) -> set[int]:
    """At which these processes listen."""
    sockets = set()
    for pid in pids:
        try:
            links = [os.readlink(entry) for entry in Path(f"/proc/{pid}/fd").iterdir()]
        except OSError:
            continue
        sockets |= {link[8:-1] for link in links if link.startswith("socket:[")}
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and words[9] in sockets:
                found.add(int(words[1].rpartition(":")[2], 16))
    return found
