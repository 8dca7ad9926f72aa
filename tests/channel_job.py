"""Starts agents and trainers of `tests.channel_ranks`, and counts what they exchanged."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from gmijax.channels.build import ChannelTopology, create_channels
from gmijax.collectives.nodes.rendezvous import reserved_address
from gmijax.config.channel import ChannelConfig
from tests.channel_ranks import ENV_FD, Options

DEFAULTS: Options = {
    "count": 1000,  # unrolls of every agent
    "steps": 3,  # T
    "envs": 10,  # N
    "sizes": (5, 2),  # observations, actions
    "batch": 25,  # B
    "timeout_s": 20.0,
    "pause_chance": 0.0,
    "busy_s": 0.0,  # what a trainer does with a batch
    "fake_device": None,  # folder of the device memory that is none, for transport=device
}


class ChannelJob:
    """Processes that share channels; a context manager that leaves none behind.

    Args:
      folder: for results.
      config: of the channels.
      topology: who takes part.
      node_of: the node of every rank, as if they were on several; None: all are on one.
      task: what differs from `DEFAULTS`.
    """

    def __init__(
        self,
        folder: Path,
        config: ChannelConfig,
        topology: ChannelTopology,
        node_of: Sequence[int] | None = None,
        **task: Any,
    ) -> None:
        self._held = ExitStack()
        self._folder = folder
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        if node_of is not None:
            topology = self._with_addresses(topology, node_of)
        self.topology = topology
        self._fd = create_channels(config, topology)
        self._held.callback(os.close, self._fd)
        self._task = {**DEFAULTS, **task, "channel": asdict(config), "topology": self._plain()}

    def __enter__(self) -> ChannelJob:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes.values():
            process.kill()
            process.wait()
        self._held.close()

    @property
    def ranks(self) -> tuple[int, ...]:
        """All that take part."""
        return (*self.topology.agents, *self.topology.trainers)

    def start(self, *ranks: int, **task: Any) -> ChannelJob:
        """Starts `ranks` (default: all), with `task` on top of the common one."""
        for rank in ranks or self.ranks:
            given = {**self._task, "rank": rank, "result": str(self._path(rank)), **task}
            with self._path(rank).with_suffix(".stderr").open("wb") as stderr:
                self._processes[rank] = subprocess.Popen(
                    [sys.executable, "-m", "tests.channel_ranks", json.dumps(given)],
                    env={**os.environ, ENV_FD: str(self._fd)},
                    cwd=Path(__file__).resolve().parents[1],
                    pass_fds=[self._fd],
                    stdin=subprocess.DEVNULL,
                    stdout=stderr,
                    stderr=stderr,
                )
        return self

    def wait_for(self, mark: str, *ranks: int, timeout_s: float = 60.0) -> None:
        """Waits until `ranks` (default: all that were started) have left a mark.

        The mark `open` says that a rank has opened its end.
        """
        deadline_s = time.monotonic() + timeout_s
        for rank in ranks or self._processes:
            while not self._path(rank).with_suffix(f".{mark}").exists():
                if time.monotonic() > deadline_s:
                    raise TimeoutError(f"rank {rank} has left no mark {mark!r}")
                time.sleep(0.002)

    def signal(self, rank: int, number: signal.Signals) -> float:
        """Sends a signal to `rank`; returns when, monotonic clock."""
        self._processes[rank].send_signal(number)
        return time.monotonic()

    def result(self, rank: int, timeout_s: float = 90.0) -> dict[str, Any]:
        """What `rank` came to, once it has ended."""
        self._processes[rank].wait(timeout_s)
        if not self._path(rank).exists():
            raise RuntimeError(self._path(rank).with_suffix(".stderr").read_text())
        return json.loads(self._path(rank).read_text())

    def numbers(self, trainer: int, agent: int) -> np.ndarray:
        """Numbers of the unrolls that `trainer` got from `agent`, as they came."""
        path = self._path(trainer).with_name(f"{self._path(trainer).name}.npy")
        agents, numbers = np.load(path) if path.exists() else np.zeros((2, 0), np.int64)
        return numbers[agents == agent]

    def _path(self, rank: int) -> Path:
        return self._folder / f"rank_{rank}"

    def _plain(self) -> dict[str, Any]:
        addresses = [[*pair, where] for pair, where in self.topology.addresses.items()]
        secret = self.topology.secret.hex()
        return {**vars(self.topology), "addresses": addresses, "secret": secret}

    def _with_addresses(
        self, topology: ChannelTopology, node_of: Sequence[int]
    ) -> ChannelTopology:
        return replace(
            topology,
            secret=os.urandom(32),
            addresses={
                (agent, trainer): self._held.enter_context(reserved_address("127.0.0.1"))
                for agent in topology.agents
                for trainer in topology.trainers
                if node_of[agent] != node_of[trainer]
            },
        )
