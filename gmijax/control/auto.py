"""What is `auto` in a training job is searched for before it starts. No jax here."""

from __future__ import annotations

import dataclasses

from rich.console import Console

from gmijax.config import TrainConfig
from gmijax.control.async_search import settled
from gmijax.control.decoupled import is_decoupled
from gmijax.control.profiling import platform_of
from gmijax.control.searching import is_auto, resolve_auto, workload_of
from gmijax.control.workload import Workload
from gmijax.partition.backend_choice import candidates, require_num_gpus
from gmijax.partition.machine import Machine
from gmijax.partition.placement import serving_and_training


def decided(
    config: TrainConfig, machine: Machine, console: Console
) -> tuple[TrainConfig, tuple[str, ...]]:
    """A training job with everything decided that was `auto`, and the reasons in words.

    Raises:
      ConfigError: too few GPUs for the job, before anything is profiled.
      ConfigError, GmijaxError, JobInterrupted: as `gmijax.control.searching.search`.
    """
    if not is_auto(config):
        return config, ()
    workload = workload_of(config)
    _require_gpus(config, workload, machine)
    result = resolve_auto(workload, config.search, machine, console)
    plan = dataclasses.replace(config.plan, gmis_per_gpu=result.gmis_per_gpu)
    if is_decoupled(config):
        plan = settled(config.plan, result.gmis_per_gpu, result.trainers, result.split)
    physics = dataclasses.replace(config.physics, impl=result.impl)
    config = dataclasses.replace(config, num_envs=result.num_envs, plan=plan, physics=physics)
    return config, (result.reason,)


def _require_gpus(config: TrainConfig, workload: Workload, machine: Machine) -> None:
    """Refuses a job that cannot start: a search by itself only projects to many GPUs."""
    if platform_of(workload, machine) == "cpu":
        return
    needed = workload.num_gpus
    if is_decoupled(config):
        serving, training, _ = serving_and_training(workload.plan)
        needed = len({*serving, *training})
    require_num_gpus(needed, candidates(workload.plan, machine))
