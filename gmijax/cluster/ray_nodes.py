"""Nodes of a cluster of Ray, with an actor of the job on each. The only file that knows Ray."""

from __future__ import annotations

import os
import re
import secrets
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Final, NamedTuple

from gmijax.clock import running_s
from gmijax.cluster.node import Facts, Node
from gmijax.cluster.remote_gmi import LOST_S, RemoteNode
from gmijax.config import ClusterConfig
from gmijax.errors import ConfigError, JobInterrupted, NodeLost, lines_of
from gmijax.machine.processes import ProcessId, identify
from gmijax.version import __version__

PASSED_ON: Final = ("JAX_", "XLA_", "NCCL_", "OMP_", "OPENBLAS_", "MKL_", "MUJOCO_", "PYTHONPATH")
"""Beginnings of variables of the controller that GMIs on other nodes get; the rest is theirs."""

_HOST_AND_PORT: Final = re.compile(r"([^/:\s]+):([0-9]{1,5})")
_MAX_PORT: Final = 65535

_POLL_S = 0.25
_CONNECT_S = 5.0
_PLACE_S = 15.0
_ACTORS_S = 120.0
_CLOSE_S = 30.0


class NodeHandle(NamedTuple):
    """A node that takes part in a job."""

    remote: RemoteNode
    facts: Facts


class RayCluster:
    """A cluster of Ray, from the connection to `close`.

    Args:
      config: which one.
      kind: what the actors hold.

    Raises:
      ConfigError: ray is not installed, or there is no cluster.
    """

    def __init__(self, config: ClusterConfig, kind: type[Node]) -> None:
        self._config, self._kind = config, kind
        self._group: Any = None
        self._actors: list[Any] = []
        with ExitStack() as held:
            if config.address == "local":
                held.enter_context(_for_this_job_alone())
            self._ray: Any = import_ray()
            if not self._ray.is_initialized():
                self._connect(config.address)
                held.callback(self._ray.shutdown)
            self._held = held.pop_all()

    def join(
        self,
        num_cpus: float,
        wanted: int | None,
        least: int | None = None,
        is_unwanted: Callable[[], bool] = lambda: False,
        least_gpus: int = 0,
        most_gpus: int | None = 0,
    ) -> list[NodeHandle]:
        """Puts an actor on each of several nodes that have so many CPUs left.

        Where GPUs may be taken and there are any, only nodes with GPUs count, and each gives as
        many as the one with the fewest has.

        Args:
          num_cpus: of each.
          wanted: how many nodes; None: all that have the CPUs.
          least: how many will do when the wait is over; None: `wanted`.
          is_unwanted: whether the user has asked for an end meanwhile.
          least_gpus: of each.
          most_gpus: of each; None: all.

        Raises:
          ConfigError: there are fewer nodes, they are not free, or one cannot take part.
          JobInterrupted: it is unwanted.
        """
        self.leave()
        deadline_s = running_s() + self._config.wait_s
        least = max(1, least or wanted or 1)
        while True:
            gpus = self._gpus_of_nodes(num_cpus, least_gpus, most_gpus)
            is_over = running_s() >= deadline_s
            if len(gpus) >= (wanted or 1) or (is_over and len(gpus) >= least):
                break
            if is_over:
                raise self._too_few(gpus, wanted, num_cpus, least_gpus)
            if is_unwanted():
                raise JobInterrupted("stopped while waiting for nodes")
            time.sleep(_POLL_S)
        num_nodes = min(len(gpus), wanted or len(gpus))
        bundle = {"CPU": num_cpus} | ({"GPU": few} if (few := gpus[num_nodes - 1]) else {})
        self._place(bundle, num_nodes, deadline_s)
        return self._joined()

    def _too_few(
        self, gpus: list[int], wanted: int | None, num_cpus: float, least_gpus: int
    ) -> ConfigError:
        some_gpus = " and a GPU" if any(gpus) or least_gpus else ""
        some_gpus = f" and {least_gpus} GPUs" if least_gpus > 1 else some_gpus
        return ConfigError(
            f"cluster.nodes={wanted or 'auto'}: the cluster has {len(gpus)} nodes with "
            f"{num_cpus} CPUs{some_gpus}, and no more came within "
            f"cluster.wait_s={self._config.wait_s:g} s"
        )

    @property
    def has_gpus(self) -> bool:
        """Whether a node has any, as far as Ray knows."""
        return any(self._gpus_of_nodes(0, 0, None))

    def leave(self) -> None:
        """Ends the actors, and with them what is left of their GMIs. Idempotent."""
        ray = self._ray
        asked = []
        for actor in self._actors:
            with suppress(Exception):
                asked.append(actor.ask.remote("close"))
        with suppress(Exception):
            ray.wait(asked, num_returns=len(asked), timeout=_CLOSE_S)
        for actor in self._actors:
            with suppress(Exception):
                ray.kill(actor)
        self._actors = []
        if self._group is not None:
            with suppress(Exception):
                ray.util.remove_placement_group(self._group)
            self._group = None

    def close(self) -> None:
        """Leaves the cluster. Idempotent."""
        self.leave()
        self._held.close()

    def _connect(self, address: str) -> None:
        found = self._found() if address == "auto" else address
        parts = _HOST_AND_PORT.fullmatch(found)
        what = f"cluster.address={address}"
        if parts and 0 < int(parts[2]) <= _MAX_PORT:
            # Ray would try for minutes.
            try:
                socket.create_connection((parts[1], int(parts[2])), _CONNECT_S).close()
            except (OSError, ValueError) as error:  # ValueError: a name that cannot be one.
                where = "there" if found == address else f"at {found}"
                raise ConfigError(f"{what}: nothing answers {where} ({error})") from None
        elif address not in ("auto", "local"):
            raise ConfigError(
                f"{what}: expected auto, local or host:port with a port from 1 to {_MAX_PORT}"
            )
        options: dict[str, Any] = {"include_dashboard": False} if address == "local" else {}
        before = signal.getsignal(signal.SIGTERM)
        try:
            # Ray's report of an error is in what it raises.
            options |= {"log_to_driver": False, "logging_level": "CRITICAL"}
            self._ray.init(address=address, **options)
        except Exception as error:
            raise ConfigError(
                f"{what}: no cluster of Ray there ({lines_of(error)[0]}); `ray start --head` "
                "starts one, `ray start --address=host:port` adds a node, and all need the same "
                "RAY_AUTH_TOKEN"
            ) from None
        finally:
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, before)  # Ray has put its own there.

    def _found(self) -> str:
        """What `auto` stands for: also a cluster that has ended, whose address Ray has kept."""
        with suppress(Exception):  # Not a public function. Without it Ray tries by itself.
            return self._ray._private.services.get_ray_address_from_environment("auto", None)
        return "auto"

    def _gpus_of_nodes(self, num_cpus: float, least_gpus: int, most_gpus: int | None) -> list[int]:
        """GPUs to be had of each node that has the CPUs, those with the most first."""
        alive = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        gpus = [int(own.get("GPU", 0)) for own in alive if own.get("CPU", 0) >= num_cpus]
        gpus = [own for own in gpus if own >= least_gpus]
        if most_gpus is not None:
            gpus = [min(own, most_gpus) for own in gpus]
        return sorted(filter(None, gpus), reverse=True) or gpus

    def _place(self, bundle: dict[str, float], num_nodes: int, deadline_s: float) -> None:
        ray = self._ray
        self._group = ray.util.placement_group([bundle] * num_nodes, strategy="STRICT_SPREAD")
        # Ray needs a moment also where nodes are free.
        if not self._group.wait(max(_PLACE_S, deadline_s - running_s())):
            self.leave()
            resources = ", ".join(f"{count} {name}s" for name, count in bundle.items())
            raise ConfigError(
                f"cluster.nodes={self._config.nodes}: no {num_nodes} nodes with {resources} free "
                f"each within cluster.wait_s={self._config.wait_s:g} s"
            )
        variables = {k: v for k, v in os.environ.items() if k.startswith(PASSED_ON)}
        arguments = (self._kind, variables, os.getcwd(), self._config.interface)
        remote = ray.remote(_NodeActor)
        for position in range(num_nodes):
            strategy = ray.util.scheduling_strategies.PlacementGroupSchedulingStrategy(
                self._group, placement_group_bundle_index=position
            )
            # Ray shows an actor the GPUs that it has asked for itself.
            options = {"num_cpus": 0, "scheduling_strategy": strategy}
            options["num_gpus"] = bundle.get("GPU", 0)
            self._actors.append(remote.options(**options).remote(*arguments))

    def _joined(self) -> list[NodeHandle]:
        ray = self._ray
        try:
            asked = [actor.ask.remote("facts", __version__) for actor in self._actors]
            answers = ray.get(asked, timeout=_ACTORS_S)
        except Exception as error:
            self.leave()
            raise ConfigError(
                f"cluster.engine=ray: a node cannot start its part of the job "
                f"({lines_of(error)[-1]}); all nodes must have the same gmijax"
            ) from None
        if problems := [answer for answer in answers if isinstance(answer, str)]:
            self.leave()
            raise ConfigError(problems[0])
        return [
            NodeHandle(RemoteNode(self._ask_of(actor), position, facts.address), facts)
            for position, (actor, facts) in enumerate(zip(self._actors, answers, strict=True))
        ]

    def _ask_of(self, actor: Any) -> Any:
        def ask(method: str, *arguments: Any) -> _RayAnswer:
            return _RayAnswer(self._ray, actor.ask.remote(method, *arguments))

        return ask


class _RayAnswer:
    """See `Answer`."""

    def __init__(self, ray: Any, reference: Any) -> None:
        self._ray, self._reference = ray, reference

    def is_there(self) -> bool:
        return bool(self._ray.wait([self._reference], timeout=0)[0])

    def get(self) -> Any:
        errors = self._ray.exceptions
        try:
            return self._ray.get(self._reference, timeout=LOST_S)
        except errors.RayTaskError as error:  # The method that was called has failed.
            raise error.cause from error
        except errors.RayError as error:
            raise NodeLost(lines_of(error)[-1]) from None


class _NodeActor:
    """Holds a `Node`, and ends with the raylet of its machine."""

    def __init__(
        self, kind: type[Node], variables: dict[str, str], folder: str, interface: str | None
    ) -> None:
        address = import_ray().util.get_node_ip_address()
        self._node = kind(variables, folder, interface, address)
        # Ray ends the actor then too, but later, and not while the raylet is a zombie.
        raylet = identify(int(os.environ.get("RAY_RAYLET_PID", "0")))
        if raylet is not None:
            threading.Thread(target=_end_with, args=(raylet,), daemon=True).start()

    def ask(self, method: str, *arguments: Any) -> Any:
        """Calls a method of the node."""
        return getattr(self._node, method)(*arguments)


@contextmanager
def _for_this_job_alone() -> Iterator[None]:
    """Variables by which Ray starts a cluster that only its own processes can join.

    It takes no connection but of this machine, and asks for a token that is in no file. Ray reads
    them when it is imported.
    """
    own = {
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        # Where it may have no other nodes, Ray listens at 127.0.0.1 alone.
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    }
    before = {name: os.environ.get(name) for name in own}
    os.environ |= own
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _end_with(process: ProcessId) -> None:
    while process.is_running():
        time.sleep(_POLL_S)
    os._exit(1)


def import_ray() -> Any:
    """The package ray; raises ConfigError if it is not installed."""
    try:
        import ray
        import ray.util.scheduling_strategies
    except ImportError:
        raise ConfigError(
            "cluster.engine=ray: the package ray is not installed (pip install 'gmijax[ray]')"
        ) from None
    return ray
