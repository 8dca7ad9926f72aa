"""An asynchronous job as data: its plan, who sends experience to whom, what its GMIs share.

Used by the controller and by the GMIs. No jax here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Final

from gmijax.collectives.board import create_registers
from gmijax.collectives.channel.build import ChannelTopology, create_channels, require_memory
from gmijax.config import A3cConfig, TrainConfig
from gmijax.errors import ConfigError
from gmijax.partition.machine import Machine
from gmijax.partition.placement import num_gmis_of, place
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan, require_host
from gmijax.partition.reduction import why_not_intra
from gmijax.partition.templates import AGENT, TRAINER, Group, group_of

MODULE: Final = "gmijax.workers.async_worker"
"""Main of every GMI, started by name."""

FLOAT_CHANNELS: Final = ("state", "action", "reward", "log_prob", "cut_value", "bootstrap")
"""Channels of an unroll that could travel with half the bits; see `gmijax.a3c.losses.Unrolls`."""

_ADVICE: Final = (
    "channels through host memory; channel.transport=device keeps experience on its GPU, which "
    "was faster on one H200 (docs/async.md)"
)

ENV_REGISTERS_FD: Final = "GMIJAX_REGISTERS_FD"
ENV_CHANNELS_FD: Final = "GMIJAX_CHANNELS_FD"


def is_decoupled(config: TrainConfig) -> bool:
    """Whether some GMIs act and others train."""
    return isinstance(config.algo, A3cConfig)


def plan_decoupled(config: TrainConfig, num_envs: int, machine: Machine) -> Plan:
    """The plan of an asynchronous job with `num_envs` environments per agent; see `make_plan`.

    Raises:
      ConfigError: no serving or no training GMI, too little memory for the channels, or what
        `make_plan` refuses.
      BackendUnavailable: the wanted backend cannot be had on this machine.
    """
    if config.channel.transport == "zmq":
        raise ConfigError(
            "channel.transport=zmq: the GMIs of a job are on one host; allowed are memory, device"
        )
    if unknown := [name for name in config.channel.float16 if name not in FLOAT_CHANNELS]:
        raise ConfigError(
            f"channel.float16={unknown}: allowed are some of {', '.join(FLOAT_CHANNELS)}"
        )
    if config.reduce.selection == "measured":
        raise ConfigError(
            "reduce.selection=measured: for jobs in which every GMI trains; with algo=a3c allowed "
            "are paper, device"
        )
    if config.plan.layout is None:
        require_host(*num_gmis_of(config.plan), config.plan, machine)
    placed = place(config.plan)
    plan = make_plan(
        placed.plan,
        config.reduce,
        num_envs,
        machine,
        template="decoupled",
        trainers=placed.trainers,
    )
    plan = dataclasses.replace(plan, reasons=(placed.reason, *plan.reasons))
    _require_experience_for_all(topology_of(plan))
    reason = why_not_device(plan)
    if config.channel.transport == "device" and reason is not None:
        raise ConfigError(f"channel.transport=device: {reason}; use memory")
    is_memory = config.channel.transport == "memory"
    if is_memory and reason is None and config.channel.why_not_device() is None:
        plan = dataclasses.replace(plan, reasons=(*plan.reasons, _ADVICE))
    # How large an unroll is shows only when the task is loaded: the GMIs check that.
    require_memory(config.channel, topology_of(plan))
    return plan


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
    if reason := why_not_intra("ipc", plan.backend):
        return reason
    topology = topology_of(plan)
    training = {topology.gpu_of[gmi] for gmi in topology.trainers}
    far = [gmi for gmi in topology.agents if topology.gpu_of[gmi] not in training]
    if not far:
        return None
    return f"agent {far[0]} is on GPU {topology.gpu_of[far[0]]} of the job, where nobody trains"


def groups_of(plan: Plan) -> tuple[Group, Group]:
    """The agents and the trainers of a plan.

    Raises:
      ConfigError: there are none of a kind.
    """
    agents = group_of(plan.layout, plan.roles, AGENT)
    trainers = group_of(plan.layout, plan.roles, TRAINER)
    if agents is None or trainers is None:
        raise ConfigError(f"plan: roles {list(plan.roles)} lack agents or trainers")
    return agents, trainers


def topology_of(plan: Plan) -> ChannelTopology:
    """Who sends experience, who receives it, and on which GPU of the job each is."""
    agents, trainers = groups_of(plan)
    layout = plan.layout
    return ChannelTopology(
        agents=agents.gmis,
        trainers=trainers.gmis,
        gpu_of=tuple(layout.gpu_of(gmi) for gmi in layout.gmis),
    )


def shared_blocks(config: TrainConfig, plan: Plan) -> Mapping[str, Callable[[], int]]:
    """What makes the memory that the GMIs share, by the variable that names its descriptor."""
    channels = partial(create_channels, config.channel, topology_of(plan))
    return MappingProxyType({ENV_REGISTERS_FD: create_registers, ENV_CHANNELS_FD: channels})
