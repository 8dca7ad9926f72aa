"""Makes the communicator of one rank, with the transport that its strategy's stages need."""

from __future__ import annotations

import socket
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import jax

from gmijax.collectives.device_transport import Device, DeviceTransport
from gmijax.collectives.host.shared_block import LANES
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.collectives.host_transport import HostTransport
from gmijax.collectives.interface import Communicator, FloatBuffer, Step, TracedStep
from gmijax.collectives.nodes.leader_watch import LeaderWatch
from gmijax.collectives.nodes.mesh import Mesh
from gmijax.collectives.nodes.multi_node_group import MultiNodeGroup
from gmijax.collectives.nodes.rendezvous import NodeAddresses, connect
from gmijax.collectives.program import ProgramStep, StagedAllReduce
from gmijax.collectives.strategies import inside_nodes, stages
from gmijax.errors import ConfigError, DeviceMemoryUnavailable
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import require_strategy, why_no_bindings

_Lane: TypeAlias = SharedMemoryGroup | MultiNodeGroup

GATHERED_FLOATS = 1024
"""Of each rank; more if P is larger than what all ranks need for these."""


@dataclass(frozen=True, kw_only=True)
class CommunicatorConfig:
    """What is needed to build the communicator of one rank.

    Attributes:
      layout: where all ranks live.
      rank: this GMI's.
      num_floats: P, length of the largest buffer whose mean is taken.
      exchange_fd: descriptor of the shared block of this node, None where there is one rank.
      timeout_s: longest wait for other ranks.
      rendezvous_timeout_s: the same in the first call, when others may still start or compile.
      intra: how the GMIs of one GPU exchange numbers in HAR, `host` or `ipc`.
      inter: how nodes exchange them, `nccl` or `tcp`; None where there is one.
      host_if_unavailable: whether ranks go through host memory, with a warning, where the memory
        of GPUs cannot be shared.
      nodes: in a job on several nodes what its leaders know of each other.
      listener: the node's listening socket, in such a job; its leader's from here on.
      gmis: ids in the job of all ranks' GMIs, by which errors name them; None: their ranks.
    """

    layout: Layout
    rank: int
    num_floats: int
    exchange_fd: int | None
    timeout_s: float
    rendezvous_timeout_s: float
    intra: str = "host"
    inter: str | None = None
    host_if_unavailable: bool = False
    nodes: NodeAddresses | None = None
    listener: socket.socket | None = None
    gmis: Sequence[int] | None = None


def make_communicator(strategy: str, config: CommunicatorConfig) -> Communicator:
    """Makes the communicator of one rank.

    Strategies that leave the host wait here until all ranks have come.

    Raises:
      ConfigError: no such strategy, or it does not work for this layout, or lacks something.
      CollectiveError: the shared memory cannot be had, or another rank is gone or does not come.
    """
    require_strategy(strategy, config.layout)
    if config.layout.num_gmis == 1:
        return SingleRankCommunicator(strategy)
    control, host = _lanes(config)
    if config.inter == "nccl":
        try:
            return _built(strategy, config, control, host)
        except DeviceMemoryUnavailable as error:
            config = replace(config, inter="tcp")
            # What failed need not be NCCL.
            instead = "tried again by TCP between nodes instead of NCCL"
            warnings.warn(f"{error}; {instead}", RuntimeWarning, stacklevel=2)
    try:
        return _built(strategy, config, control, host)
    except DeviceMemoryUnavailable as error:
        if not config.host_if_unavailable:
            raise
        instead = "mpr" if strategy == "one_shot" else strategy
        what = f"reduce.strategy={instead} through host memory"
        warnings.warn(f"{error}; so {what}", RuntimeWarning, stacklevel=2)
        return _built(instead, replace(config, intra="host"), control, host)


def _built(strategy: str, config: CommunicatorConfig, control: _Lane, host: _Lane) -> Communicator:
    layout, num_floats = config.layout, _capacity(config)
    parts = stages(strategy, layout, config.intra, config.inter)
    device, transport = DEVICE(), None
    try:
        if config.inter == "nccl" and (device is None or device.new_ring is None):
            raise ConfigError("exchanges between nodes by NCCL need GPUs")
        if device is None or all(stage.transport in ("host", "nodes") for stage in parts):
            transport = HostTransport(host, num_floats)
        else:
            transport = DeviceTransport(control, host, layout, num_floats, parts, device)
        ranks = host.rank, host.world_size
        all_reduce = StagedAllReduce(transport, parts, *ranks)
        inside = inside_nodes(parts, layout)
        checks = [all_reduce.is_right]
        if len(inside) < len(parts):
            # A rank that finds that it does not work must not leave other nodes waiting for a sum.
            first = StagedAllReduce(transport, inside, *ranks).is_right
            checks = [first, *checks] if config.inter == "nccl" else [first]
        transport.start(checks)
    except BaseException as error:
        if transport is not None:
            transport.close()
        if not isinstance(error, DeviceMemoryUnavailable):
            host.close()
            control.close()
        raise
    return MultiRankCommunicator(strategy, config, control, host, all_reduce)


class MultiRankCommunicator:
    """The `Communicator` of one of several ranks."""

    def __init__(
        self,
        strategy: str,
        config: CommunicatorConfig,
        control: _Lane,
        host: _Lane,
        all_reduce: StagedAllReduce,
    ) -> None:
        self.rank, self.world_size = host.rank, host.world_size
        self.strategy, self.intra, self.inter = strategy, config.intra, config.inter
        self._control, self._host, self._all_reduce = control, host, all_reduce

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """See `Communicator`."""
        return self._control.all_gather(values)

    def program(self, step: Step, *, donates_own: bool = True) -> TracedStep:
        """See `Communicator`."""
        return self._all_reduce.program(step, donates_own=donates_own)

    def close(self) -> None:
        """See `Communicator`."""
        self._all_reduce.close()
        self._host.close()
        self._control.close()


class SingleRankCommunicator:
    """The `Communicator` of a job with one trainer."""

    rank, world_size, intra = 0, 1, "host"
    inter: str | None = None

    def __init__(self, strategy: str = "none") -> None:
        self.strategy = strategy

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """See `Communicator`."""
        return values[None].copy()

    def program(self, step: Step, *, donates_own: bool = True) -> TracedStep:
        """See `Communicator`."""
        return ProgramStep(None, None, step, donates_own=donates_own)

    def close(self) -> None:
        """Does nothing: there is nothing to release."""


def _lanes(config: CommunicatorConfig) -> Sequence[_Lane]:
    assert config.exchange_fd is not None
    layout, rank = config.layout, config.rank
    here, ids = layout.gmis_of_node[layout.node_of(rank)], _ids(config)
    lanes = [
        SharedMemoryGroup(
            *(config.exchange_fd, here.index(rank), len(here), _capacity(config)),
            timeout_s=config.timeout_s,
            rendezvous_timeout_s=config.rendezvous_timeout_s,
            lane=lane,
            ids=[ids[other] for other in here],
        )
        for lane in range(LANES)
    ]
    return lanes if layout.num_nodes == 1 else _over_nodes(config, lanes, leader=here[0])


def _over_nodes(
    config: CommunicatorConfig, lanes: Sequence[SharedMemoryGroup], leader: int
) -> Sequence[MultiNodeGroup]:
    """The lanes, connected between nodes; leaders wait here for each other."""
    layout, rank = config.layout, config.rank
    nodes, listener = config.nodes, config.listener
    if nodes is None or listener is None:
        raise ConfigError(f"layout {layout} on {layout.num_nodes} nodes: needs their addresses")
    with listener:
        if rank != leader:
            return [MultiNodeGroup(lane, layout, rank) for lane in lanes]
        *sockets, watched = connect(nodes, listener, len(lanes) + 1, config.rendezvous_timeout_s)
    leaders = [_ids(config)[ranks[0]] for ranks in layout.gmis_of_node]
    watch = LeaderWatch(watched, nodes.node, leaders)
    meshes = [
        Mesh(
            *(connections, nodes.node, leaders),
            timeout_s=config.timeout_s,
            rendezvous_timeout_s=config.rendezvous_timeout_s,
            on_wait=lane.heartbeat,
        )
        for connections, lane in zip(sockets, lanes, strict=True)
    ]
    # The first lane is that of the thread which waits while the device is at a step.
    watches = [watch, None]
    return [
        MultiNodeGroup(lane, layout, rank, mesh, watch)
        for lane, mesh, watch in zip(lanes, meshes, watches, strict=True)
    ]


def _ids(config: CommunicatorConfig) -> Sequence[int]:
    return config.layout.gmis if config.gmis is None else config.gmis


def _capacity(config: CommunicatorConfig) -> int:
    """Length of the largest buffer that is summed; a gather sums one buffer of all ranks."""
    return max(config.num_floats, GATHERED_FLOATS * config.layout.num_gmis)


def _device() -> Device | None:
    """What the transport of this process's GPU is made of; None on a CPU."""
    if jax.local_devices()[0].platform != "gpu":
        return None
    if reason := why_no_bindings():
        raise ConfigError(f"GMIs that train together on GPUs: {reason}")
    from gmijax.collectives.device.cuda_memory import CudaMemory
    from gmijax.collectives.device.cuda_queue import CudaQueue
    from gmijax.collectives.device.nccl_ring import nccl_ring

    return Device(CudaMemory, CudaQueue, nccl_ring)


DEVICE: Callable[[], Device | None] = _device
