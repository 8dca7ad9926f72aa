"""Kinds of jobs: their plans, the main that their GMIs run, the memory that these share.

Real jobs, their restarts and the profiles of a search all start GMIs by these; GMIs of
asynchronous jobs ask here which GMIs the others are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Final

from gmijax.channels.build import ChannelTopology, create_channels, require_memory
from gmijax.channels.pipe_block import create_pipes
from gmijax.channels.registers import create_registers
from gmijax.config import ServeConfig, TrainConfig
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import Machine
from gmijax.partition.placement import num_gmis_of, on_fewer_nodes, place
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan, require_host
from gmijax.partition.reduction import why_not_intra
from gmijax.partition.templates import AGENT, TRAINER, Group, group_of
from gmijax.supervise.child import ENV_PIPES_FD

ROLLOUT_PIPE_BYTES: Final = 16 << 20
"""Of a pipe between a trainer and a GMI that makes its rollouts; larger messages are divided."""

ENV_REGISTERS_FD: Final = "GMIJAX_REGISTERS_FD"
ENV_CHANNELS_FD: Final = "GMIJAX_CHANNELS_FD"

_ADVICE: Final = (
    "channels through host memory; channel.transport=device keeps experience on its GPU, which "
    "was faster on one H200 (docs/async.md)"
)

SharedBlocks = Mapping[str, Callable[[], int]]
"""What makes memory that the GMIs share, by the variable that names its descriptor."""


@dataclass(frozen=True)
class JobKind:
    """Main of the GMIs of a job, and the memory that they share.

    Attributes:
      module: main of every GMI, started by name.
      shared: the memory that the GMIs of a plan share, beside that of the communicator.
      calls: between GMIs of different nodes, which connect by TCP: listener and connector.
    """

    module: str
    shared: Callable[[Plan], SharedBlocks] = lambda _: MappingProxyType({})
    calls: Callable[[Plan], Sequence[tuple[int, int]]] = lambda _: ()


MEMBERS_VARIABLE: Final = "GMIJAX_MEMBERS"
"""Run folders of the runs that are one program, as a JSON list."""

PACKED: Final = JobKind("gmijax.workers.packed_worker")
"""Several runs in one program of one GMI."""

SYNCHRONOUS: Final = JobKind("gmijax.workers.training_worker")
"""Training in which every GMI simulates, acts and trains (TCG_EX)."""


def training_kind(config: TrainConfig) -> JobKind:
    """The kind of a training job."""
    if config.is_decoupled:
        shared = partial(_registers_and_channels, config)
        return JobKind(SYNCHRONOUS.module, shared=shared, calls=calls_of)
    if config.plan.template == "tdg_ex":
        shared = partial(pipes, ROLLOUT_PIPE_BYTES)
        return JobKind(SYNCHRONOUS.module, shared=shared)
    return SYNCHRONOUS


def serving_kind(config: ServeConfig) -> JobKind:
    """The kind of a job that makes experience without training."""

    def shared(plan: Plan) -> SharedBlocks:
        return pipes(config.pipe_bytes, plan) if plan.template == "tdg" else {}

    return JobKind("gmijax.workers.serving_worker", shared=shared)


def pipes(num_bytes: int, plan: Plan) -> SharedBlocks:
    """Pipes of so many bytes between all GMIs of a plan."""
    return {ENV_PIPES_FD: partial(create_pipes, plan.layout.num_gmis, num_bytes)}


def _registers_and_channels(config: TrainConfig, plan: Plan) -> SharedBlocks:
    channels = partial(create_channels, config.channel, topology_of(plan))
    return {ENV_REGISTERS_FD: create_registers, ENV_CHANNELS_FD: channels}


def training_plan(
    config: TrainConfig,
    machine: Machine,
    num_envs: int | None = None,
    nodes: Mapping[str, Machine] | None = None,
) -> Plan:
    """The plan of a training job, with `num_envs` per GMI if it is given; see `make_plan`.

    Raises:
      ConfigError: what `make_plan` refuses; in an asynchronous job no serving or no training GMI,
        or too little memory for the channels.
      BackendUnavailable: the wanted backend cannot be had on this machine.
    """
    num_envs = num_envs or config.envs_per_gmi
    if not config.is_decoupled:
        return make_plan(config.plan, config.reduce, num_envs, machine, nodes=nodes)
    if config.plan.layout is None and nodes is None:
        require_host(*num_gmis_of(config.plan), config.plan, machine)
    requested, num_nodes = config.plan, 1
    if nodes is not None:
        assert config.cluster.nodes != "auto"
        num_nodes = len(nodes)
        requested = on_fewer_nodes(requested, config.cluster.nodes, num_nodes)
    placed = place(requested, num_nodes)
    plan = make_plan(
        placed.plan,
        config.reduce,
        num_envs,
        machine,
        template="decoupled",
        trainers=placed.trainers,
        nodes=nodes,
    )
    topology, channel = topology_of(plan), config.channel
    _require_experience_for_all(topology)
    why_not = why_not_device(plan)
    if channel.transport == "device" and why_not is not None:
        raise ConfigError(f"channel.transport=device: {why_not}; use memory")
    # How large an unroll is shows only when the task is loaded: the GMIs check that.
    require_memory(channel, topology)
    could_stay = why_not is None and channel.why_not_device() is None
    advice = (_ADVICE,) if could_stay and channel.transport == "memory" else ()
    return dataclasses.replace(plan, reasons=(placed.reason, *plan.reasons, *advice))


def _require_experience_for_all(topology: ChannelTopology) -> None:
    """Refuses a placement in which a trainer gets nothing: all trainers learn in step.

    An agent with trainers on its own GPU sends to these only.
    """
    serving = {topology.gpu_of[gmi] for gmi in topology.agents}
    training = {topology.gpu_of[gmi] for gmi in topology.trainers}
    if serving <= training and (idle := sorted(training - serving)):
        raise ConfigError(
            f"plan.training_gpus: trainers on GPU {idle[0]} of the job would get no experience, "
            "because every agent has a trainer on its own GPU; let GPUs both act and train, or "
            "keep the two apart"
        )


def why_not_device(plan: Plan) -> str | None:
    """None if experience can stay in memory of the GPUs, else the reason."""
    if plan.layout.num_nodes > 1:
        return "the job is on several nodes"
    if reason := why_not_intra("ipc", plan.backend):
        return reason
    topology = topology_of(plan)
    training = {topology.gpu_of[gmi] for gmi in topology.trainers}
    far = [gmi for gmi in topology.agents if topology.gpu_of[gmi] not in training]
    if not far:
        return None
    return f"agent {far[0]} is on GPU {topology.gpu_of[far[0]]} of the job, where no GMI trains"


def groups_of(plan: Plan) -> tuple[Group, Group]:
    """The agents and the trainers of an asynchronous job."""
    agents = group_of(plan.layout, plan.roles, AGENT)
    trainers = group_of(plan.layout, plan.roles, TRAINER)
    assert agents is not None
    assert trainers is not None
    return agents, trainers


def calls_of(plan: Plan) -> tuple[tuple[int, int], ...]:
    """Pairs of GMIs of an asynchronous job on different nodes: listener, connector.

    Agents connect to trainers with their experience, the leading trainer to agents with weights.
    """
    agents, trainers = (group.gmis for group in groups_of(plan))
    pairs = [(trainer, agent) for trainer in trainers for agent in agents]
    pairs += [(agent, trainers[0]) for agent in agents]
    node_of = plan.layout.node_of
    return tuple(pair for pair in pairs if node_of(pair[0]) != node_of(pair[1]))


def topology_of(plan: Plan) -> ChannelTopology:
    """The GMIs that send experience, those that receive it, and the GPU of each."""
    agents, trainers = groups_of(plan)
    layout = plan.layout
    gpu_of = tuple(layout.gpu_of(gmi) for gmi in layout.gmis)
    return ChannelTopology(agents=agents.gmis, trainers=trainers.gmis, gpu_of=gpu_of)
