"""Jobs that a search can profile: what a profile runs, and its result."""

from __future__ import annotations

import dataclasses
import platform
import statistics
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Generic, Literal, NamedTuple, TypeVar

from gmijax.autotune.grid import Measured, Point
from gmijax.autotune.search import estimate
from gmijax.config import (
    PlanConfig,
    ReduceConfig,
    ServeConfig,
    TemplateName,
    TrainConfig,
)
from gmijax.config.schema import to_dict
from gmijax.config.search import PROFILED_ITERATIONS
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.history import read_metrics
from gmijax.runs.result import TrainResult
from gmijax.supervise.job_kinds import JobKind, serving_kind, training_kind
from gmijax.supervise.watched_gmi import GmiStatus
from gmijax.version import versions_of

C = TypeVar("C", TrainConfig, ServeConfig)

VERSIONS: Final = ("gmijax", "jax", "jaxlib", "mujoco-mjx", "warp-lang")
"""What decides with the machine and the configuration how fast a job is."""


class Split(NamedTuple):
    """How many GPUs of a job act and how many train, where none does both."""

    serving: int
    training: int


class Workload(ABC, Generic[C]):
    """A job that can be profiled, and what is `auto` in it.

    Attributes:
      config: of the job, its task pinned.
      kind: what its GMIs run and share.
      plan: how the whole job is to be spread.
      reduce: how it is to reduce.
      template: what `plan.template=auto` means; no other can be profiled.
      trainers: training GMIs on every GPU that trains; 0: every GMI does everything.

    Raises:
      ConfigError: a template that cannot be profiled.
    """

    template: TemplateName
    trainers: int = 0

    def __init__(self, config: C, kind: JobKind, reduce: ReduceConfig) -> None:
        config.plan.require_template((self.template,), "a search (numbers that are auto)")
        self.config = config
        self.kind = kind
        self.plan = config.plan
        self.reduce = reduce

    @abstractmethod
    def config_at(self, point: Point, num_gmis: int) -> C:
        """The configuration of the short job that profiles a point with so many GMIs.

        Raises:
          ConfigError: there can be none.
        """

    @abstractmethod
    def read(self, plan: Plan, run: RunPaths) -> Measured:
        """Figures of one GMI from the run folder of a profile."""

    @property
    @abstractmethod
    def key(self) -> Mapping[str, Any]:
        """What else decides how fast the job is, plain data."""

    def plan_at(self, point: Point, machine: Machine) -> Plan:
        """The plan of a profile, of all GMIs on the first GPU of the job.

        Raises:
          ConfigError: a point that the machine or the backend does not allow.
        """
        gpus = self.plan.gpus
        one_gpu = dataclasses.replace(
            self.plan,
            gpus=1 if isinstance(gpus, int) else gpus[:1],
            gmis_per_gpu=point.gmis_per_gpu,
            layout=None,
        )
        return make_plan(one_gpu, self.reduce, point.num_envs, machine, template=self.template)

    def enough(self, plan: Plan, run: RunPaths) -> Callable[[Sequence[GmiStatus]], bool] | None:
        """What decides when a profile can be read; None: it ends by itself."""
        del plan, run
        return None

    def projected(self, point: Point, measured: Measured) -> float:
        """Environment steps a second of the whole job."""
        return estimate(point.gmis_per_gpu, self.plan.num_gpus, measured)

    def top(self, measured: Measured) -> float:
        """What Sat goes by; the paper's `top`."""
        return measured.env_steps_per_s

    def split(self, measured: Measured) -> Split | None:
        """GPUs that act and that train, where none does both."""
        del measured
        return None

    def settled(self, point: Point, split: Split | None) -> C:
        """The job with what a search has found."""
        return self.with_point(point, plan=self.settled_plan(point, split))

    def with_point(self, point: Point, **changes: Any) -> C:
        """The job's configuration with environments and physics of a point, and other changes."""
        physics = dataclasses.replace(self.config.physics, impl=point.impl)
        return dataclasses.replace(
            self.config, num_envs=point.num_envs, physics=physics, **changes
        )

    def settled_plan(self, point: Point, split: Split | None) -> PlanConfig:
        """See `settled`."""
        del split
        return dataclasses.replace(self.config.plan, gmis_per_gpu=point.gmis_per_gpu)

    def platform_on(self, machine: Machine) -> Literal["cpu", "gpu"]:
        """Platform of the GMIs."""
        return "gpu" if machine.gpus and self.plan.backend != "cpu" else "cpu"

    def device(self, machine: Machine) -> str:
        """The model of the job's first GPU, or the CPU's architecture and cores."""
        if self.platform_on(machine) == "cpu":
            return f"{platform.machine()} CPU, {len(machine.cpu_cores)} cores"
        gpus = self.plan.gpus
        wanted = None if isinstance(gpus, int) else gpus[0]
        chosen = next((gpu for gpu in machine.gpus if gpu.index == wanted), machine.gpus[0])
        return f"{chosen.name}, {chosen.memory_mib} MiB"

    def store_key(self, machine: Machine) -> dict[str, Any]:
        """Everything but the point on which a profile's result depends; see `ProfileStore`."""
        plan, reduce = to_dict(self.plan), to_dict(self.reduce)
        for name in ("gpus", "gmis_per_gpu", "layout"):
            del plan[name]
        del reduce["timeout_s"]
        return {
            "device": self.device(machine),
            "task": self.config.env.slug,
            "env": to_dict(self.config.env),
            "plan": plan,
            "reduce": reduce,
            "mps": machine.mps_control is not None,
            "driver": machine.driver_version,
            "versions": versions_of(VERSIONS),
            **self.key,
        }


class SynchronousWorkload(Workload[TrainConfig]):
    """Synchronous training."""

    template = "tcg_ex"

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config, training_kind(config), config.reduce)

    @property
    def key(self) -> Mapping[str, Any]:
        """See `Workload`."""
        algo = to_dict(self.config.algo)
        return {"job": "train", "algo": algo, "iterations": PROFILED_ITERATIONS}

    def config_at(self, point: Point, num_gmis: int) -> TrainConfig:
        """See `Workload`."""
        config = self.config
        steps = point.num_envs * config.algo.unroll_length * num_gmis
        run = dataclasses.replace(
            config.run, resume=None, checkpoint_every=0, measure_throughput=False, profile=None
        )
        no_eval = dataclasses.replace(config.eval, every=None, video=False)
        steps *= PROFILED_ITERATIONS
        return self.with_point(point, num_timesteps=steps, run=run, eval=no_eval)

    def read(self, plan: Plan, run: RunPaths) -> Measured:
        """See `Workload`."""
        result = TrainResult.read(run.gmi(0).result)
        if result is None or result.step_per_s_train is None:
            raise ValueError("the leader measured no rate")
        all_steps_per_s = result.step_per_s_train  # The median, of all GMIs together.
        steps = result.env_steps / result.iterations
        # The first iteration fills caches and pools.
        lines = read_metrics(run.metrics)[1:]
        return Measured(
            env_steps_per_s=all_steps_per_s / plan.layout.num_gmis,
            memory_mib=peak_memory_mib(results_of(plan, run)),
            iteration_s=steps / all_steps_per_s,
            reduce_s=statistics.median(line.get("time/reduce_s", 0.0) for line in lines),
        )


class ServeWorkload(Workload[ServeConfig]):
    """Serving; experience is not written while it is profiled."""

    template = "tcg"

    def __init__(self, config: ServeConfig) -> None:
        super().__init__(config, serving_kind(config), ReduceConfig())

    @property
    def key(self) -> Mapping[str, Any]:
        """See `Workload`."""
        config = self.config
        # Which weights act makes no difference; their shapes do, and they are the run's.
        return {
            "job": "serve",
            "policy": config.policy,
            "run": config.run.dir,
            "unroll_length": config.unroll_length,
            "iterations": PROFILED_ITERATIONS,
        }

    def config_at(self, point: Point, num_gmis: int) -> ServeConfig:
        """See `Workload`."""
        config = self.config
        steps = point.num_envs * config.unroll_length * num_gmis
        return self.with_point(
            point,
            num_timesteps=PROFILED_ITERATIONS * steps,
            output=dataclasses.replace(config.output, dir=None),
            latency_steps=0,
        )

    def read(self, plan: Plan, run: RunPaths) -> Measured:
        """See `Workload`."""
        results = results_of(plan, run)
        mean_rate = statistics.fmean(float(one["step_per_s_inference"]) for one in results)
        return Measured(
            env_steps_per_s=mean_rate,
            memory_mib=peak_memory_mib(results),
            iteration_s=results[0]["env_steps"] / results[0]["unrolls"] / mean_rate,
        )


def results_of(plan: Plan, run: RunPaths) -> list[dict[str, Any]]:
    """What every GMI returned, in order of id."""
    return [read_json(run.gmi(gmi).result) for gmi in plan.layout.gmis]


def peak_memory_mib(results: Sequence[Mapping[str, Any]]) -> float:
    """The largest peak of any GMI, as its allocator counts; on the CPU, of the process."""
    devices = [result["device"] for result in results if "device" in result]
    return max(float(one["peak_memory_mib"] or one["peak_host_memory_mib"]) for one in devices)
