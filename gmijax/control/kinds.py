"""Kinds of jobs: what differs between them when their GMIs are started. No jax here.

Real jobs, their restarts and the profiles of a search all start GMIs by these.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Final, NamedTuple, Protocol

from gmijax.collectives.pipe_block import create_pipes
from gmijax.config import ServeConfig, TrainConfig
from gmijax.control import decoupled
from gmijax.partition.child import ENV_PIPES_FD
from gmijax.partition.machine import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan

ROLLOUT_PIPE_BYTES: Final = 16 << 20
"""Of a pipe between a trainer and who makes its rollouts; larger messages go in pieces."""

SharedBlocks = Mapping[str, Callable[[], int]]
"""What makes memory that the GMIs share, by the variable that names its descriptor."""


class JobKind(Protocol):
    """What the GMIs of a job run and share."""

    @property
    def module(self) -> str:
        """Main of every GMI, started by name."""
        ...

    @property
    def compile_once(self) -> bool:
        """Whether all GMIs run the same programs, so that one compiles them for all."""
        ...

    def shared(self, plan: Plan) -> SharedBlocks:
        """The memory that the GMIs of a plan share, beside that of the reducer."""
        ...


class Plain(NamedTuple):
    """Any main; memory that does not depend on the plan."""

    module: str
    compile_once: bool = True
    blocks: SharedBlocks = MappingProxyType({})

    def shared(self, plan: Plan) -> SharedBlocks:
        """See `JobKind`."""
        del plan
        return self.blocks


SYNCHRONOUS: Final = Plain("gmijax.workers.worker")
"""Training in which every GMI simulates, acts and trains (TCG_EX)."""


class Dedicated(NamedTuple):
    """Synchronous training with trainers in GMIs of their own (TDG_EX)."""

    module: str = "gmijax.workers.worker"
    compile_once: bool = False

    def shared(self, plan: Plan) -> SharedBlocks:
        """See `JobKind`."""
        return {ENV_PIPES_FD: partial(create_pipes, plan.layout.num_gmis, ROLLOUT_PIPE_BYTES)}


class Decoupled(NamedTuple):
    """Asynchronous training: some GMIs act, others train."""

    config: TrainConfig
    module: str = decoupled.MODULE
    compile_once: bool = False

    def shared(self, plan: Plan) -> SharedBlocks:
        """See `JobKind`."""
        return decoupled.shared_blocks(self.config, plan)


class Serving(NamedTuple):
    """Experience without training."""

    config: ServeConfig
    module: str = "gmijax.workers.serving_worker"
    compile_once: bool = True

    def shared(self, plan: Plan) -> SharedBlocks:
        """See `JobKind`."""
        if plan.template != "tdg":
            return {}
        pipes = partial(create_pipes, plan.layout.num_gmis, self.config.pipe_bytes)
        return {ENV_PIPES_FD: pipes}


def training_kind(config: TrainConfig) -> JobKind:
    """The kind of a training job."""
    if decoupled.is_decoupled(config):
        return Decoupled(config)
    return Dedicated() if config.plan.template == "tdg_ex" else SYNCHRONOUS


def training_plan(config: TrainConfig, machine: Machine) -> Plan:
    """The plan of a training job whose numbers are all decided; raises as `make_plan`."""
    if decoupled.is_decoupled(config):
        return decoupled.plan_decoupled(config, config.envs_per_gmi, machine)
    return make_plan(config.plan, config.reduce, config.envs_per_gmi, machine)
