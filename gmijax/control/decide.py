"""Decides everything that is `auto` in a job, before anything is made or started."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Generic, NamedTuple, TypeVar

from rich.console import Console

from gmijax.autotune.tuner import with_auto_decided
from gmijax.config import ReduceConfig, ServeConfig, TrainConfig
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.sim import source
from gmijax.sim.impl import choose_impl
from gmijax.sim.registry import require_env
from gmijax.supervise.job_kinds import training_plan

C = TypeVar("C", TrainConfig, ServeConfig)


class JobSpec(NamedTuple, Generic[C]):
    """A job that is ready to start.

    Attributes:
      config: with nothing `auto` in it that GMIs would have to decide.
      plan: of the job.
      machine: where it runs.
      reasons: what was decided beside the plan, in words.
    """

    config: C
    plan: Plan
    machine: Machine
    reasons: tuple[str, ...]


def with_task(config: C) -> C:
    """With its task pinned; raises ConfigError as `require_env` and `source.pinned`."""
    require_env(config.env)
    return dataclasses.replace(config, env=source.pinned(config.env))


def decide(config: C, console: Console, nodes: Mapping[str, Machine] | None = None) -> JobSpec[C]:
    """Numbers of GMIs and environments, plan, reduction and physics of a job, in this order.

    `nodes` are the machines of a job on several, by address.

    Raises:
      ConfigError, GmijaxError, JobInterrupted: as `with_auto_decided` and `make_plan`.
    """
    machine = next(iter(nodes.values())) if nodes else detect_machine()
    config, found = with_auto_decided(config, machine, console)
    if isinstance(config, ServeConfig):
        # No GMI trains, so none averages gradients.
        nothing, num_envs = ReduceConfig(), config.envs_per_gmi
        plan = make_plan(config.plan, nothing, num_envs, machine, template="tcg")
    else:
        plan = training_plan(config, machine, nodes=nodes)
    platform = "cpu" if plan.backend == "cpu" else "gpu"
    impl, why = choose_impl(config.physics.impl, platform, config.env.label)
    config = dataclasses.replace(config, physics=dataclasses.replace(config.physics, impl=impl))
    return JobSpec(config, plan, machine, (*found, f"physics.impl {impl}: {why}"))
