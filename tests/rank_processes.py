"""Runs small bodies of code in several real processes that share one communicator.

This file is a script too: a server that has loaded jax, which is most of what a rank costs, and
forks for every rank that `Ranks` starts. A rank makes its communicator, runs the body named in
its options and writes what the body returns, or how it failed, to a JSON file.
"""

from __future__ import annotations

import faulthandler
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from gmijax.collectives.communicator import CommunicatorConfig, make_communicator
from gmijax.collectives.host.shared_block import create_exchange
from gmijax.collectives.interface import Communicator
from gmijax.collectives.nodes.rendezvous import (
    ENV_LISTENER_FD,
    ENV_NODES_FD,
    NodeAddresses,
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


class RankProcess:
    """A process that a server has forked."""

    def __init__(self, pid: int, pidfd: int) -> None:
        self.pid = pid
        self._pidfd = pidfd

    def send_signal(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError):  # It has ended.
            signal.pidfd_send_signal(self._pidfd, number)

    def ends_within(self, limit_s: float) -> bool:
        return bool(select.select([self._pidfd], [], [], limit_s)[0])

    def close(self) -> None:
        self.send_signal(signal.SIGKILL)
        assert self.ends_within(WAIT_S)
        os.close(self._pidfd)


class Ranks:
    """Processes of one job: a context manager that leaves none behind.

    `results()` waits for all that were not killed; each result has `error` (class name or None)
    and the body's own keys.
    All ranks are on one GPU unless `layout` says something else, and on `num_nodes` machines, all
    of which are this one.
    """

    def __init__(self, folder: Path, world_size: int, body: str, **options: Any) -> None:
        self.folder, self.world_size = folder, world_size
        self._held = ExitStack()
        self.processes: dict[int, RankProcess] = {}
        defaults = {"strategy": "mpr", "num_floats": 100, "timeout_s": 20.0, "start_s": 60.0}
        layout = [list(range(world_size))]
        # Devices by position of a GPU in the layout; none: the CPU.
        defaults |= {"intra": "host", "layout": layout, "num_nodes": 1, "gpus": []}
        defaults["inter"] = None
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
            process.close()
        self._held.close()

    def start(self, *ranks: int, **options: Any) -> Ranks:
        """Starts `ranks` (default: all), with `options` on top of the common ones."""
        for rank in ranks or range(self.world_size):
            given = {**self._options, "rank": rank, "folder": str(self.folder), **options}
            inherited = self._fds[layout_of(given).node_of(rank)]
            with (self.folder / f"stderr_{rank}").open("wb") as stderr:
                self.processes[rank] = start_rank(given, inherited, stderr.fileno())
        return self

    def wait_for(self, mark: str) -> None:
        """Waits until every rank has left the file `mark`."""
        deadline = time.monotonic() + WAIT_S
        for rank, process in self.processes.items():
            while not (self.folder / f"{mark}_{rank}").exists():
                stderr = self.folder / f"stderr_{rank}"
                assert time.monotonic() < deadline, f"no {mark}: {stderr.read_text()}"
                # It may leave the mark and end, in this order, since we looked.
                has_ended = process.ends_within(0.01)
                assert not has_ended or (self.folder / f"{mark}_{rank}").exists(), (
                    f"no {mark}: {stderr.read_text()}"
                )

    def named_memory(self) -> set[Path]:
        """Files below /dev/shm that the running ranks have mapped."""
        maps = [Path(f"/proc/{p.pid}/maps").read_text() for p in self.processes.values()]
        return {
            Path("/dev/shm" + line.partition("/dev/shm")[2])
            for line in "".join(maps).splitlines()
            if "/dev/shm" in line
        }

    def signal(self, rank: int, number: signal.Signals) -> None:
        """Sends a signal to `rank`."""
        self.processes[rank].send_signal(number)

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
                own[ENV_NODES_FD] = NodeAddresses(node, addresses, b"secret").to_file()
            for fd in own.values():
                self._held.callback(os.close, fd)
            found.append(own | ({ENV_LISTENER_FD: listener.fileno()} if num_nodes > 1 else {}))
        return found

    def _wait_for_end(self, rank: int) -> None:
        process = self.processes[rank]
        if not process.ends_within(WAIT_S):
            process.send_signal(signal.SIGUSR1)  # It says where it is, see `main`.
            time.sleep(1.0)
            has_result = (self.folder / f"result_{rank}").exists()
            stderr = (self.folder / f"stderr_{rank}").read_text()
            pytest.fail(f"rank {rank} does not end, has a result: {has_result}\n{stderr}")


def start_rank(options: Options, inherited: dict[str, int], stderr: int) -> RankProcess:
    """Has a server fork a process with these open files, named by variables."""
    _, server = _server("cuda" if options["gpus"] else "cpu")
    variables = {**os.environ, **environment_of(options)}
    message = json.dumps([options, variables, list(inherited)])
    socket.send_fds(server, [message.encode()], [stderr, *inherited.values()])
    pid, (pidfd,), _, _ = socket.recv_fds(server, 100, 1)
    return RankProcess(int(pid), pidfd)


@cache
def _server(platform: str) -> tuple[subprocess.Popen[bytes], socket.socket]:
    """Starts the server of a platform; it ends, with its ranks, when this process does."""
    own, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    path = os.pathsep.join(filter(None, (str(REPOSITORY), os.environ.get("PYTHONPATH"))))
    process = subprocess.Popen(
        # The warning of jax is meant for parents that compute; this one only imports.
        [sys.executable, "-W", "ignore:os.fork", __file__, str(its.fileno())],
        env={**os.environ, "PYTHONPATH": path, "JAX_PLATFORMS": platform},
        pass_fds=[its.fileno()],
        stdin=subprocess.DEVNULL,
    )
    its.close()
    return process, own


def serve(requests: socket.socket) -> Options:
    """Forks at every request; returns in the new process, the options of its rank."""
    import fake_device_memory  # noqa: F401
    import jax.numpy  # noqa: F401

    ranks: set[int] = set()
    while True:
        message, fds, _, _ = socket.recv_fds(requests, 1 << 20, 4)
        # Until now what has ended was a zombie, so that its number was nobody else's.
        ranks -= {pid for pid in ranks if os.waitpid(pid, os.WNOHANG)[0]}
        if not message:
            for pid in ranks:
                os.kill(pid, signal.SIGKILL)
            sys.exit()
        pid = os.fork()
        if pid == 0:
            requests.close()
            return _become_rank(message, *fds)
        ranks.add(pid)
        fds.append(os.pidfd_open(pid))
        socket.send_fds(requests, [str(pid).encode()], fds[-1:])
        for fd in fds:
            os.close(fd)


def _become_rank(message: bytes, stderr: int, *inherited: int) -> Options:
    options, variables, names = json.loads(message)
    for standard in (1, 2):
        os.dup2(stderr, standard)
    os.close(stderr)
    os.environ.clear()
    os.environ.update(variables)
    os.environ.update({name: str(fd) for name, fd in zip(names, inherited, strict=True)})
    return options


def environment_of(options: Options) -> dict[str, str]:
    """What the variables of one rank have more than those of the tests."""
    if not options["gpus"]:
        return {}
    return {
        "CUDA_VISIBLE_DEVICES": str(options["gpus"][layout_of(options).gpu_of(options["rank"])]),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        "XLA_FLAGS": "--xla_gpu_shard_autotuning=false",
        "NCCL_NVLS_ENABLE": "0",
    }


def layout_of(options: Options) -> Layout:
    """The layout that the options describe."""
    return Layout(tuple(tuple(gmis) for gmis in options["layout"]), options["num_nodes"])


def use_fake_device(kind: str, *, has_rings: bool) -> None:
    """Lets `intra=ipc` and rings run on the CPU: the real exchange over what is not a GPU's.

    Args:
      kind: a key of `FAKES`, or of what NCCL lacks, see `fake_nccl.install`.
      has_rings: whether rings are those of (a stand-in for) NCCL.
    """
    import fake_device_memory
    import fake_nccl

    from gmijax.collectives import communicator
    from gmijax.collectives.device.nccl_ring import nccl_ring

    device = fake_device_memory.FAKES.get(kind, fake_device_memory.FAKES["fake"])
    if has_rings:
        fake_nccl.install(kind)
        device = device._replace(new_ring=nccl_ring)
    communicator.DEVICE = lambda: device


def communicator_of(options: Options) -> Communicator:
    """The communicator of one rank."""
    strategy, rank, layout = options["strategy"], options["rank"], layout_of(options)
    nodes, listener = inherited_nodes()
    has_rings = options["inter"] == "nccl"
    if (options["intra"] == "ipc" or has_rings) and not options["gpus"]:
        is_special = rank == options.get("special_rank")
        use_fake_device(options["special"] if is_special else "fake", has_rings=has_rings)
    return make_communicator(
        strategy,
        CommunicatorConfig(
            layout=layout,
            rank=rank,
            num_floats=options["num_floats"],
            exchange_fd=int(os.environ[ENV_EXCHANGE_FD]),
            timeout_s=options["timeout_s"],
            rendezvous_timeout_s=options["start_s"],
            intra=options["intra"],
            inter=options["inter"],
            host_if_unavailable=options.get("host_if_unavailable", False),
            nodes=nodes,
            listener=listener,
        ),
    )


def main(options: Options) -> None:
    """One rank: builds its communicator, runs the body, writes the result."""
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    result: Options = {"error": None}
    failure: GmijaxError | None = None
    try:
        comm = communicator_of(options)
        try:
            result |= getattr(rank_bodies, options["body"])(comm, options)
        finally:
            comm.close()
            comm.close()
    except GmijaxError as error:
        failure = error
        result |= {"error": type(error).__name__, "message": str(error)}
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
    main(serve(socket.socket(fileno=int(sys.argv[1]))))
