"""Runs small bodies of code in several real processes that share one reducer.

`Ranks` starts this file as a script, once a rank. A child builds its reducer, runs the body
named in its options and writes what the body returns, or how it failed, to a JSON file.
"""

from __future__ import annotations

import faulthandler
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from gmijax.collectives.build import Membership, build_reducer
from gmijax.collectives.host.shared_block import create_exchange
from gmijax.collectives.interface import Reducer
from gmijax.collectives.nodes.meeting import (
    ENV_LISTENER_FD,
    ENV_NODES_FD,
    Nodes,
    inherited_nodes,
    listen,
)
from gmijax.errors import CollectiveTimeout, GmijaxError, PeerLost
from gmijax.partition.layout import Layout
from gmijax.supervise.child import ENV_EXCHANGE_FD
from tests import rank_bodies
from tests.rank_bodies import Options

WAIT_S = 90.0
REPOSITORY = Path(__file__).resolve().parents[1]


class Ranks:
    """Processes of one job: a context manager that leaves none behind.

    `results()` waits for all that were not killed; each result has `error` (class name or
    None), `failed_at_s` (monotonic clock, the same for all processes) and the body's own keys.
    All ranks are on one GPU unless `layout` says something else, and on `num_nodes` machines, all
    of which are this one.
    """

    def __init__(self, folder: Path, world_size: int, body: str, **options: Any) -> None:
        self.folder, self.world_size = folder, world_size
        self._held = ExitStack()
        self.processes: dict[int, subprocess.Popen[bytes]] = {}
        defaults = {"strategy": "mpr", "num_floats": 100, "timeout_s": 20.0, "start_s": 60.0}
        layout = [list(range(world_size))]
        # Devices by position of a GPU in the layout; none: the CPU.
        defaults |= {"intra": "host", "layout": layout, "num_nodes": 1, "gpus": []}
        self._options = {**defaults, "body": body, **options}
        self._fds = self._shared_by_nodes(self._options["num_nodes"])

    @property
    def fd(self) -> int:
        """Descriptor of the shared block of the first node."""
        return self._fds[0][ENV_EXCHANGE_FD]

    def __enter__(self) -> Ranks:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes.values():
            process.kill()
            process.wait()
        self._held.close()

    def start(self, *ranks: int, **options: Any) -> Ranks:
        """Starts `ranks` (default: all), with `options` on top of the common ones."""
        for rank in ranks or range(self.world_size):
            given = {**self._options, "rank": rank, "folder": str(self.folder), **options}
            inherited = self._fds[layout_of(given).node_of(rank)]
            named = {name: str(fd) for name, fd in inherited.items()}
            with (self.folder / f"stderr_{rank}").open("wb") as stderr:
                self.processes[rank] = subprocess.Popen(
                    [sys.executable, __file__, json.dumps(given)],
                    env={**os.environ, **environment_of(given), **named},
                    pass_fds=list(inherited.values()),
                    stdin=subprocess.DEVNULL,
                    stdout=stderr,
                    stderr=stderr,
                )
        return self

    def wait_for(self, mark: str) -> None:
        """Waits until every rank has left the file `mark`."""
        deadline = time.monotonic() + WAIT_S
        for rank, process in self.processes.items():
            while not (self.folder / f"{mark}_{rank}").exists():
                said = self.folder / f"stderr_{rank}"
                assert time.monotonic() < deadline, f"no {mark}: {said.read_text()}"
                # It may leave the mark and end, in this order, since we looked.
                assert process.poll() is None or (self.folder / f"{mark}_{rank}").exists(), (
                    f"no {mark}: {said.read_text()}"
                )
                time.sleep(0.01)

    def named_memory(self) -> set[Path]:
        """Files below /dev/shm that the running ranks have mapped."""
        maps = [Path(f"/proc/{p.pid}/maps").read_text() for p in self.processes.values()]
        return {
            Path("/dev/shm" + line.partition("/dev/shm")[2])
            for line in "".join(maps).splitlines()
            if "/dev/shm" in line
        }

    def signal(self, rank: int, number: signal.Signals) -> float:
        """Sends a signal to `rank`; returns when, monotonic clock."""
        self.processes[rank].send_signal(number)
        return time.monotonic()

    def results(self, *ranks: int) -> list[dict[str, Any]]:
        """What `ranks` (default: all) came to, once their processes have ended."""
        found = []
        for rank in ranks or range(self.world_size):
            self._wait_for_end(rank)
            path = self.folder / f"result_{rank}"
            assert path.exists(), (self.folder / f"stderr_{rank}").read_text()
            found.append(json.loads(path.read_text()))
        return found

    def _shared_by_nodes(self, num_nodes: int) -> list[dict[str, int]]:
        """What the ranks of each node inherit, by the variable that names its descriptor."""
        listeners = [self._held.enter_context(listen("127.0.0.1")) for _ in range(num_nodes)]
        addresses = tuple(("127.0.0.1", one.getsockname()[1]) for one in listeners)
        found: list[dict[str, int]] = []
        for node, listener in enumerate(listeners):
            own = {ENV_EXCHANGE_FD: create_exchange()}
            if num_nodes > 1:
                own[ENV_NODES_FD] = Nodes(node, addresses, b"secret").to_file()
            for fd in own.values():
                self._held.callback(os.close, fd)
            found.append(own | ({ENV_LISTENER_FD: listener.fileno()} if num_nodes > 1 else {}))
        return found

    def _wait_for_end(self, rank: int) -> None:
        process = self.processes[rank]
        try:
            process.wait(WAIT_S)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGUSR1)  # It says where it is, see `main`.
            time.sleep(1.0)
            has_result = (self.folder / f"result_{rank}").exists()
            said = (self.folder / f"stderr_{rank}").read_text()
            pytest.fail(f"rank {rank} does not end, has a result: {has_result}\n{said}")


def environment_of(options: Options) -> dict[str, str]:
    """Variables of one rank."""
    path = os.pathsep.join(filter(None, (str(REPOSITORY), os.environ.get("PYTHONPATH"))))
    if not options["gpus"]:
        return {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu"}
    return {
        "PYTHONPATH": path,
        "JAX_PLATFORMS": "cuda",
        "CUDA_VISIBLE_DEVICES": str(options["gpus"][layout_of(options).gpu_of(options["rank"])]),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        "XLA_FLAGS": "--xla_gpu_shard_autotuning=false",
        "NCCL_NVLS_ENABLE": "0",
    }


def layout_of(options: Options) -> Layout:
    """The layout that the options describe."""
    return Layout(tuple(tuple(gmis) for gmis in options["layout"]), options["num_nodes"])


def use_fake_device_memory(kind: str) -> None:
    """Lets `intra=ipc` run on the CPU: the real exchange over memory that is not a GPU's."""
    import fake_device_memory

    from gmijax.collectives import build

    build.DEVICE = lambda: fake_device_memory.FAKES[kind]


def make_reducer(options: Options) -> Reducer:
    """The reducer of one rank."""
    strategy, rank, layout = options["strategy"], options["rank"], layout_of(options)
    nodes, listener = inherited_nodes()
    if options["intra"] == "ipc" and not options["gpus"]:
        is_special = rank == options.get("special_rank")
        use_fake_device_memory(options["special"] if is_special else "fake")
    return build_reducer(
        strategy,
        Membership(
            layout=layout,
            rank=rank,
            num_floats=options["num_floats"],
            exchange_fd=int(os.environ[ENV_EXCHANGE_FD]),
            timeout_s=options["timeout_s"],
            rendezvous_timeout_s=options["start_s"],
            intra=options["intra"],
            host_if_unavailable=options.get("host_if_unavailable", False),
            nodes=nodes,
            listener=listener,
        ),
    )


def main(options: Options) -> None:
    """One rank: builds its reducer, runs the body, writes the result."""
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    result: Options = {"error": None}
    failure: GmijaxError | None = None
    try:
        reducer = make_reducer(options)
        try:
            result |= getattr(rank_bodies, options["body"])(reducer, options)
        finally:
            reducer.close()
            reducer.close()
    except GmijaxError as error:
        failure = error
        result |= {"error": type(error).__name__, "message": str(error)}
        result["failed_at_s"] = time.monotonic()
        if isinstance(error, PeerLost):
            result["peer"] = error.peer
        if isinstance(error, CollectiveTimeout):
            result["missing"] = list(error.missing)
    path = Path(options["folder"]) / f"result_{options['rank']}"
    path.with_suffix(".part").write_text(json.dumps(result))
    path.with_suffix(".part").rename(path)
    if failure is not None:
        raise failure  # As a GMI ends, see `WatchedThread`.


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
