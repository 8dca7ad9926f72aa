"""The plan of a job that continues without the GPUs or nodes that it has lost."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from gmijax.config import PlanConfig, TrainConfig
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.supervise.job_kinds import training_plan


def with_gpus_left(
    config: TrainConfig, plan: Plan, machine: Machine
) -> tuple[TrainConfig, Plan, tuple[str, ...]]:
    """The job as it can continue, with Algorithm 1 decided again where GPUs are gone.

    Every GMI keeps its number of environments, so there are fewer of them in all.

    Returns:
      Configuration and plan, both as they were where no GPU is gone, and sentences for the user.

    Raises:
      ConfigError: GPUs are gone, and the job may not or cannot continue with those that are left.
    """
    lost = _lost(plan, machine)
    if not lost:
        return config, plan, ()
    num_left = plan.layout.num_gpus - len(lost)
    gone = f"GPUs {sorted(lost)} of the job are gone"
    if not config.run.elastic:
        raise ConfigError(f"{gone}; run.elastic=true would continue with the {num_left} left")
    if num_left == 0:
        raise ConfigError(f"{gone}, and no other one is left")
    if config.is_decoupled and config.plan.serving_gpus is not None:
        raise ConfigError(f"{gone}; plan.serving_gpus and plan.training_gpus name them")
    config = dataclasses.replace(config, plan=_without(config, plan, machine, lost))
    shrunk = training_plan(config, machine)
    note = (
        f"{gone}: continuing with {num_left}, layout {shrunk.layout}, "
        f"reduction {shrunk.strategy}; {shrunk.num_envs_per_gmi} environments per GMI as before"
    )
    return config, dataclasses.replace(shrunk, reasons=(*shrunk.reasons, note)), (note,)


def with_nodes_left(
    config: TrainConfig, plan: Plan, nodes: Mapping[str, Machine]
) -> tuple[Plan, tuple[str, ...]]:
    """The plan for the nodes that a job has now, and sentences for the user if they are fewer."""
    again = training_plan(config, next(iter(nodes.values())), nodes=nodes)
    num_lost = len(plan.nodes) - len(nodes)
    if not num_lost:
        return again, ()
    note = (
        f"{num_lost} nodes of the job are gone: continuing with {len(nodes)}, layout "
        f"{again.layout}; {again.num_envs_per_gmi} environments per GMI as before"
    )
    return dataclasses.replace(again, reasons=(*again.reasons, note)), (note,)


def _lost(plan: Plan, machine: Machine) -> set[int]:
    """Positions in the job of the GPUs that the machine no longer has."""
    if plan.backend == "cpu":
        return set()
    present = machine.index_of_device
    return {allocation.gpu for allocation in plan.allocations if allocation.device not in present}


def _without(config: TrainConfig, plan: Plan, machine: Machine, lost: set[int]) -> PlanConfig:
    """The requested plan for the GPUs that are left, which keep their indices."""
    kept = [position for position in range(plan.layout.num_gpus) if position not in lost]
    index_of = machine.index_of_device
    device_of = {allocation.gpu: allocation.device for allocation in plan.allocations}
    gpus = tuple(index_of[device_of[position]] for position in kept)
    rows = config.plan.layout
    if rows is not None:
        new_ids = {old: new for new, old in enumerate(sorted(i for p in kept for i in rows[p]))}
        rows = tuple(tuple(new_ids[i] for i in rows[position]) for position in kept)
    return dataclasses.replace(config.plan, gpus=gpus, layout=rows)
