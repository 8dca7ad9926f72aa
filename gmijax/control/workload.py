"""A kind of job that a search can profile, and synchronous training as one. No jax here."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from gmijax.config import EnvConfig, PlanConfig, PpoConfig, ReduceConfig, TemplateName, TrainConfig
from gmijax.control.kinds import SYNCHRONOUS, JobKind
from gmijax.errors import ConfigError
from gmijax.partition.balance import Split
from gmijax.partition.gmi_process import GmiStatus
from gmijax.partition.machine import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.points import Measured, Point
from gmijax.partition.search import estimate, top_of_one
from gmijax.results import read_metrics
from gmijax.rundir import RunPaths, read_json
from gmijax.schema import to_dict

IsEnough = Callable[[Sequence[GmiStatus]], bool]


@dataclass(frozen=True, kw_only=True)
class Workload:
    """A kind of job that can be profiled, and what is `auto` in it.

    Attributes:
      env: the task, pinned.
      plan: how the whole job is to be spread.
      reduce: how it is to reduce.
      num_envs: environments per GMI, or `auto`.
      impl: physics implementation, or `auto`.
      template: what `plan.template=auto` means.
      kind: what its GMIs run and share.
      config_at: the configuration of the short job that profiles a point with so many GMIs; it
        is what the GMIs read from the run folder. Raises ConfigError if there can be none.
      read: what one GMI did, from the run folder of that job.
      key: what else decides how fast it is, plain data.
      trainers: numbers of training GMIs per GPU to choose from; (0,): every GMI does everything.
      plan_of: the plan of a profile where the template's own GMIs are not all that there is.
      is_enough: what says when a profile can be read; None: it ends by itself.
      estimate: environment steps a second of the whole job; None: of the same on every GPU.
      top: what Sat goes by.
      split: GPUs that act and that train where none does both.
    """

    env: EnvConfig
    plan: PlanConfig
    reduce: ReduceConfig
    num_envs: int | Literal["auto"]
    impl: str
    template: TemplateName
    kind: JobKind
    config_at: Callable[[Point, int], Any]
    read: Callable[[Plan, RunPaths], Measured]
    key: Mapping[str, Any]
    trainers: tuple[int, ...] = (0,)
    plan_of: Callable[[Point, Machine], Plan] | None = None
    is_enough: Callable[[Plan, RunPaths], IsEnough] | None = None
    estimate: Callable[[Point, Measured], float] | None = None
    top: Callable[[Measured], float] = top_of_one
    split: Callable[[Measured], Split | None] = lambda _: None

    def projected(self, point: Point, measured: Measured) -> float:
        """Environment steps a second of the whole job."""
        if self.estimate is not None:
            return self.estimate(point, measured)
        return estimate(point.gmis_per_gpu, self.num_gpus, measured)

    @property
    def num_gpus(self) -> int:
        """GPUs of the whole job."""
        if self.plan.layout is not None:
            return len(self.plan.layout)
        return self.plan.gpus if isinstance(self.plan.gpus, int) else len(self.plan.gpus)


def training(config: TrainConfig) -> Workload:
    """Synchronous training as a workload.

    Raises:
      ConfigError: a job whose template the search cannot profile.
    """
    if not isinstance(config.algo, PpoConfig) or config.plan.template not in ("auto", "tcg_ex"):
        raise ConfigError(
            "num_envs=auto, plan.gmis_per_gpu=auto: with algo=ppo can be found for "
            "plan.template=tcg_ex only; give numbers"
        )

    def config_at(point: Point, num_gmis: int) -> TrainConfig:
        steps = point.num_envs * config.algo.unroll_length * num_gmis
        return dataclasses.replace(
            config,
            num_envs=point.num_envs,
            num_timesteps=config.search.iterations * steps,
            physics=dataclasses.replace(config.physics, impl=point.impl),
            run=dataclasses.replace(
                config.run, resume=None, checkpoint_every=0, measure_throughput=False
            ),
        )

    return Workload(
        env=config.env,
        plan=config.plan,
        reduce=config.reduce,
        num_envs=config.num_envs,
        impl=config.physics.impl,
        template="tcg_ex",
        kind=SYNCHRONOUS,
        config_at=config_at,
        read=_read_training,
        key={"job": "train", "algo": to_dict(config.algo), "iterations": config.search.iterations},
    )


def _read_training(plan: Plan, run: RunPaths) -> Measured:
    results = [read_json(run.gmi(gmi).result) for gmi in plan.layout.gmis]
    all_steps_per_s = results[0]["step_per_s_train"]  # The median, of all GMIs together.
    steps = results[0]["env_steps"] / results[0]["iterations"]
    # The first iteration fills caches and pools.
    lines = read_metrics(run.metrics)[1:]
    return Measured(
        env_steps_per_s=all_steps_per_s / plan.layout.num_gmis,
        memory_mib=max(peak_memory_mib(result["device"]) for result in results),
        iteration_s=steps / all_steps_per_s,
        reduce_s=statistics.median(line.get("time/reduce_s", 0.0) for line in lines),
    )


def peak_memory_mib(device: Mapping[str, Any]) -> float:
    """Of a GMI's device, as its allocator counts; where it does not (the CPU), of the process."""
    return float(device["peak_memory_mib"] or device["peak_host_memory_mib"])
