"""What one node does for a job, in an actor of Ray: it starts and holds processes of its machine.

It holds what GMIs of one machine share and their lifelines, so they end with it. What becomes of
them is decided by the controller's supervisor.
"""

from __future__ import annotations

import dataclasses
import fcntl
import os
import platform
import signal
import socket
import struct
from collections.abc import Collection, Mapping
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from gmijax.collectives.nodes.rendezvous import (
    ENV_LISTENER_FD,
    ENV_NODES_FD,
    NodeAddresses,
    listen,
    reserved_address,
)
from gmijax.errors import (
    BackendUnavailable,
    ConfigError,
    GmiFailed,
    GmijaxError,
    ReportedError,
)
from gmijax.machine.differences import differences_in
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.supervise.backends import open_backend
from gmijax.supervise.environment import NCCL_INTERFACE
from gmijax.supervise.gmi_process import GmiProcess
from gmijax.supervise.heartbeat import Heartbeat
from gmijax.supervise.run_gmis import drop_unreadable, shared_blocks
from gmijax.supervise.start_gmi import Launch, StartGmi, start_gmi
from gmijax.version import __version__, versions_of

ON_GPUS: Final = (
    *("jax-cuda12-plugin", "jax-cuda13-plugin", "nvidia-nccl-cu12", "nvidia-nccl-cu13"),
    *("cuda-bindings", "nccl4py", "warp-lang"),
)
"""Packages that compute on GPUs; the controller may be on a machine without any."""

COMPARED: Final = (
    *("gmijax", "python", "jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx", "flax", "optax"),
    *ON_GPUS,
)
"""What all nodes must have in the same version, `ON_GPUS` where GPUs are used."""

Order = Literal["ask_to_stop", "order_end", "end_as_done", "kill"]
"""Methods of a `GmiProcess` that the controller may call."""

_SIOCGIFADDR: Final = 0x8915


class Facts(NamedTuple):
    """What a node is.

    Attributes:
      address: IP address for the exchange with other nodes.
      machine: what it has.
      versions: of all that computes, by package; see `COMPARED`.
    """

    address: str
    machine: Machine
    versions: dict[str, str | None]


class NodeEndpoints(NamedTuple):
    """What a node has for its GMIs: where they will listen, and daemons of its GPUs.

    Attributes:
      leader: address and port of its leading GMI.
      calls: see `NodeAddresses`.
      daemons: see `Machine`.
    """

    leader: tuple[str, int]
    calls: dict[tuple[int, int], str]
    daemons: dict[str, Path]


class RemoteGmiStatus(NamedTuple):
    """What a node knows of a GMI; see `WatchedGmi`."""

    exit_code: int | None
    beats: int
    beat: Heartbeat
    error: ReportedError | None
    log_bytes: int


class Node:
    """This machine's part of a job: what every kind of job needs of it.

    Args:
      variables: environment variables of the controller that its GMIs get.
      folder: working directory of the controller, taken where it is here too.
      interface: network interface of the exchange; None: that of `address`.
      address: IP address by which Ray knows this machine.
    """

    def __init__(
        self, variables: Mapping[str, str], folder: str, interface: str | None, address: str
    ) -> None:
        # Ray sets one thread unless the user has set a number; GMIs get what fits their cores.
        os.environ.pop("OMP_NUM_THREADS", None)
        os.environ.update(variables)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        if Path(folder).is_dir():
            os.chdir(folder)
        self._interface, self._address = interface, address

    def facts(self, version: str) -> Facts | str:
        """What this machine is, or why it cannot take part.

        Args:
          version: of gmijax in the controller; another one may not understand the facts.
        """
        versions = {"this machine": version, self._address: __version__}
        if differ := differences_in("gmijax", versions):
            return f"cluster.engine=ray: {differ[0]}; all nodes must have the same"
        try:
            address = address_of(self._interface) if self._interface else self._address
            return Facts(address, detect_machine(), versions_of(COMPARED))
        except GmijaxError as error:
            return str(error)

    def sees(self, probe: str, content: str) -> bool:
        """Whether a file is here as the controller has written it, and its folder can be written.

        A network file system may show it late, so it is asked again.
        """
        with suppress(OSError):
            path = Path(probe)
            os.listdir(path.parent)  # Has the file system look again.
            return path.read_text() == content and os.access(path.parent, os.W_OK)
        return False

    def close(self) -> None:
        """Ends what is left, and gives back what was made."""


class TrainingNode(Node):
    """The GMIs of a training job on this machine, and what they share."""

    def __init__(
        self, variables: Mapping[str, str], folder: str, interface: str | None, address: str
    ) -> None:
        super().__init__(variables, folder, interface, address)
        self._held = ExitStack()
        self._launch: Launch | None = None
        self._listener: socket.socket | None = None
        self._blocks: dict[str, int] = {}
        self._start: StartGmi | None = None
        self._started: dict[int, GmiProcess] = {}
        self._num_gmis = 0

    def open(
        self, launch: Launch, node: int, address: str, daemons: Mapping[str, Path]
    ) -> NodeEndpoints | BackendUnavailable:
        """Makes what the GMIs share, or reports why this machine cannot; may be called again.

        Args:
          launch: what to run.
          node: position of this one.
          address: where GMIs are to listen.
          daemons: of nodes before this one, which may be on the same machine.
        """
        self._held.close()  # Of another backend, which another node could not have.
        try:
            return self._open(launch, node, address, daemons)
        except BackendUnavailable as error:
            self._held.close()
            return error

    def _open(
        self, launch: Launch, node: int, address: str, daemons: Mapping[str, Path]
    ) -> NodeEndpoints:
        self._launch = launch
        own = launch.run.node(node)
        own.root.mkdir(exist_ok=True)
        self._held.callback(_remove_if_empty, own.root)
        self._blocks = shared_blocks(self._held, launch.kind, launch.plan)
        machine, layout = detect_machine(), launch.plan.layout
        # Clients of a second daemon for a GPU would take turns with those of the first.
        machine = dataclasses.replace(machine, daemons={**daemons, **machine.daemons})
        backend = open_backend(launch.plan, machine, own, layout.gmis_of_node[node])
        self._backend = self._held.enter_context(backend)
        found = dict(backend.daemons)
        if layout.num_nodes == 1:
            return NodeEndpoints((address, 0), {}, found)
        interface = interface_of(address) if launch.plan.inter == "nccl" else None
        if interface is not None:
            # By the network of the other exchanges; GMIs inherit it. `=`: this name, no beginning.
            os.environ.setdefault(NCCL_INTERFACE, f"={interface}")
        self._listener = self._held.enter_context(listen(address))
        self._blocks[ENV_LISTENER_FD] = self._listener.fileno()
        calls = {
            pair: self._held.enter_context(reserved_address(address))
            for pair in launch.kind.calls(launch.plan)
            if layout.node_of(pair[0]) == node
        }
        return NodeEndpoints((address, self._listener.getsockname()[1]), calls, found)

    def set_addresses(self, nodes: NodeAddresses) -> None:
        """Takes the addresses of all leaders; GMIs can be started from here on."""
        assert self._launch is not None
        if self._listener is not None:
            self._blocks[ENV_NODES_FD] = nodes.to_file()
            self._held.callback(os.close, self._blocks[ENV_NODES_FD])
        self._num_gmis = len(self._launch.plan.layout.gmis_of_node[nodes.node])
        self._start = partial(start_gmi, self._launch, self._backend, self._blocks)

    def start(self, gmi: int) -> int | str:
        """Starts a GMI; its process, or why there is none."""
        assert self._start is not None
        try:
            process = self._start(gmi)
        except GmiFailed as error:
            return error.reason
        assert isinstance(process, GmiProcess)
        self._started[gmi] = process
        self._backend.started(process.pid)
        if len(self._started) == self._num_gmis and self._listener is not None:
            self._listener.close()  # From here on it is their leader's alone.
        return process.pid

    def verify(self, pids: Mapping[int, int]) -> tuple[int, str] | None:
        """See `Backend.verify`; the GMI without its share, and the reason."""
        try:
            self._backend.verify(pids)
        except GmiFailed as error:
            return error.gmi, error.reason
        return None

    def terminate(self, gmi: int, pids: Collection[int]) -> None:
        """See `Backend.terminate`."""
        self._backend.terminate(gmi, pids)

    def poll(self) -> dict[int, RemoteGmiStatus]:
        """How every GMI is."""
        for process in self._started.values():
            process.poll()
        return {
            gmi: RemoteGmiStatus(one.exit_code, one.beats, one.beat, one.error, one.log_bytes)
            for gmi, one in self._started.items()
        }

    def order(self, gmi: int, order: Order) -> None:
        """Does what the controller requests with a GMI."""
        getattr(self._started[gmi], order)()

    def request_stacks(self, gmi: int) -> int | None:
        """See `WatchedGmi`."""
        return self._started[gmi].request_stacks()

    def close(self) -> None:
        """See `Node`."""
        for process in self._started.values():
            process.poll()
            process.kill()
            process.poll()
            process.close()
        if self._launch is not None:
            drop_unreadable(self._launch.run, self._started)
        self._held.close()


def address_of(interface: str) -> str:
    """The IPv4 address of a network interface.

    Raises:
      ConfigError: there is no such one here, or it has none.
    """
    if (address := _ipv4_of(interface)) is None:
        names = ", ".join(name for _, name in socket.if_nameindex())
        raise ConfigError(
            f"cluster.interface={interface}: node {platform.node()} has no such interface "
            f"with an IPv4 address; it has {names}"
        )
    return address


def interface_of(address: str) -> str | None:
    """The network interface with this IPv4 address; None if it is not the first of any."""
    names = (name for _, name in socket.if_nameindex())
    return next((name for name in names if _ipv4_of(name) == address), None)


def _ipv4_of(interface: str) -> str | None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        request = struct.pack("256s", interface.encode()[:15])
        with suppress(OSError):
            answer: Any = fcntl.ioctl(asking.fileno(), _SIOCGIFADDR, request)
            return socket.inet_ntoa(answer[20:24])
    return None


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()
