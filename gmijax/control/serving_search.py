"""`num_envs=auto plan.gmis_per_gpu=auto` in a serving job: what a search profiles. No jax here."""

from __future__ import annotations

import dataclasses
from typing import Final

from rich.console import Console

from gmijax.config import AUTO, ReduceConfig, ServeConfig
from gmijax.control.kinds import Serving
from gmijax.control.searching import resolve_auto
from gmijax.control.workload import Workload, peak_memory_mib
from gmijax.errors import ConfigError
from gmijax.partition.machine import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.points import Measured, Point
from gmijax.rundir import RunPaths, read_json

NO_REDUCTION: Final = ReduceConfig(strategy="auto", intra="auto", timeout_s=1.0)
"""Nobody trains, so nobody averages gradients."""


def decided(
    config: ServeConfig, machine: Machine, console: Console
) -> tuple[ServeConfig, tuple[str, ...]]:
    """The job with everything decided that was `auto`, and the reasons in words.

    Raises:
      ConfigError, GmijaxError, JobInterrupted: as `gmijax.control.searching.search`.
    """
    if AUTO not in (config.num_envs, config.plan.gmis_per_gpu):
        return config, ()
    result = resolve_auto(serving(config), config.search, machine, console)
    settled = dataclasses.replace(
        config,
        num_envs=result.num_envs,
        plan=dataclasses.replace(config.plan, gmis_per_gpu=result.gmis_per_gpu),
        physics=dataclasses.replace(config.physics, impl=result.impl),
    )
    return settled, (result.reason,)


def serving(config: ServeConfig) -> Workload:
    """Serving as a workload; experience is not written while it is profiled.

    Raises:
      ConfigError: a job whose template the search cannot profile.
    """
    if config.plan.template not in ("auto", "tcg"):
        raise ConfigError(
            "num_envs=auto, plan.gmis_per_gpu=auto: can be found for plan.template=tcg only; give "
            "numbers"
        )

    def config_at(point: Point, num_gmis: int) -> ServeConfig:
        steps = point.num_envs * config.unroll_length * num_gmis
        return dataclasses.replace(
            config,
            num_envs=point.num_envs,
            num_timesteps=config.search.iterations * steps,
            physics=dataclasses.replace(config.physics, impl=point.impl),
            output=dataclasses.replace(config.output, dir=None),
            latency_steps=0,
        )

    return Workload(
        env=config.env,
        plan=config.plan,
        reduce=NO_REDUCTION,
        num_envs=config.num_envs,
        impl=config.physics.impl,
        template="tcg",
        kind=Serving(config),
        config_at=config_at,
        read=_read,
        # Which weights act makes no difference; their shapes do, and they are the run's.
        key={
            "job": "serve",
            "policy": config.policy,
            "run": config.run.dir,
            "unroll_length": config.unroll_length,
            "iterations": config.search.iterations,
        },
    )


def _read(plan: Plan, run: RunPaths) -> Measured:
    results = [read_json(run.gmi(gmi).result) for gmi in plan.layout.gmis]
    rates = [float(result["step_per_s_inference"]) for result in results]
    mean_rate = sum(rates) / len(rates)
    steps = results[0]["env_steps"] / results[0]["unrolls"]
    return Measured(
        env_steps_per_s=mean_rate,
        memory_mib=max(peak_memory_mib(result["device"]) for result in results),
        iteration_s=steps / mean_rate,
        reduce_s=0.0,
    )
