"""Asynchronous training as a workload: how many GMIs act and train, on how many GPUs.

A profile is a real job, on one GPU where every GPU of the job acts and trains, else on one that
acts and one that trains.

The paper divides the GPUs of such a job by hand (section 5.1, decoupled). Here the division
follows from what one serving and one training GPU can do: trainers learn from nothing that was
not made, and no agent makes what will not be taken, so that s and t of them make
min(s acting, t learning) environment steps a second. TTOP cannot exceed PPS.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from gmijax.autotune.async_profile import ProfileWindow, measured_of, window_start
from gmijax.autotune.grid import Measured, Point
from gmijax.autotune.workloads import Split, Workload, peak_memory_mib, results_of
from gmijax.config import AUTO, PlanConfig, TrainConfig
from gmijax.config.schema import to_dict
from gmijax.config.search import PROFILED_ITERATIONS
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import Machine
from gmijax.partition.placement import place, serving_and_training
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths
from gmijax.runs.history import read_metrics
from gmijax.supervise.job_kinds import groups_of, training_kind, training_plan
from gmijax.supervise.watched_gmi import GmiStatus

_ENDLESS_STEPS: Final = 10**15


class A3cWorkload(Workload[TrainConfig]):
    """Asynchronous training.

    Raises:
      ConfigError: a job that the search cannot profile, or a placement that cannot be.
    """

    template = "decoupled"

    def __init__(self, config: TrainConfig) -> None:
        super().__init__(config, training_kind(config), config.reduce)
        given = _without_auto(config.plan)
        place(given)
        serving, training, indices = serving_and_training(given)
        self._given = given
        self._counts = Split(len(serving), len(training))
        self._is_apart = _is_apart(serving, training, indices)
        is_auto = config.plan.gmis_per_gpu == AUTO
        # As one object, and without what a profile does not depend on.
        self.plan = dataclasses.replace(
            given,
            gpus=indices or len({*serving, *training}),
            gmis_per_gpu=AUTO if is_auto else given.num_serving_gmis,
            serving_gpus=None,
            training_gpus=None,
            serving_gmis_per_gpu=1,
            training_gmis_per_gpu=1,
        )
        self.trainers = given.training_gmis_per_gpu

    @property
    def key(self) -> Mapping[str, Any]:
        """See `Workload`."""
        config = self.config
        return {
            "job": "train",
            "algo": to_dict(config.algo),
            "channel": to_dict(config.channel),
            "placement": "apart" if self._is_apart else "together",
            "iterations": PROFILED_ITERATIONS,
        }

    def config_at(self, point: Point, num_gmis: int) -> TrainConfig:
        """See `Workload`."""
        del num_gmis
        run = dataclasses.replace(self.config.run, resume=None, checkpoint_every=0, profile=None)
        # It ends when there is enough to read.
        return self.with_point(point, num_timesteps=_ENDLESS_STEPS, run=run)

    def plan_at(self, point: Point, machine: Machine) -> Plan:
        """See `Workload`; on one GPU that does both, or on one that acts and one that trains."""
        plan = _with_gmis(self._profiled_on(), point)
        return training_plan(dataclasses.replace(self.config, plan=plan), machine, point.num_envs)

    def _profiled_on(self) -> PlanConfig:
        plan = self._given
        serving, training, indices = serving_and_training(plan)
        if not self._is_apart:
            gpus = 1 if indices is None else (indices[serving[0]],)
            return dataclasses.replace(plan, gpus=gpus, serving_gpus=None, training_gpus=None)
        if indices is None:
            return dataclasses.replace(plan, gpus=2, serving_gpus=1, training_gpus=1)
        acts, trains = indices[serving[0]], indices[training[0]]
        return dataclasses.replace(
            plan, gpus=(acts, trains), serving_gpus=(acts,), training_gpus=(trains,)
        )

    def enough(self, plan: Plan, run: RunPaths) -> Callable[[Sequence[GmiStatus]], bool]:
        """See `Workload`."""
        return ProfileWindow(self.config, plan, run)

    def read(self, plan: Plan, run: RunPaths) -> Measured:
        """See `Workload`; raises ValueError for too few lines of metrics."""
        lines = read_metrics(run.metrics)[:-1]  # The last may hold the end of the job.
        start = window_start(lines, PROFILED_ITERATIONS)
        if start is None:
            raise ValueError(f"{len(lines)} lines of metrics are too few")
        num_agents = len(groups_of(plan)[0].gmis)
        memory_mib = peak_memory_mib(results_of(plan, run))
        return measured_of(lines[start - 1 :], num_agents, memory_mib)

    def projected(self, point: Point, measured: Measured) -> float:
        """See `Workload`."""
        profiled = point.gmis_per_gpu * measured.env_steps_per_s
        split = self.split(measured)
        if split is None:
            return self._counts.serving * profiled
        rates = measured.acting_per_s, measured.learning_per_s
        # Each side waits now and then although the other is the slower one: so in the profile.
        return profiled * throughput(split, *rates) / min(rates)

    def top(self, measured: Measured) -> float:
        """See `Workload`; where GPUs act and train apart, by the slower side."""
        if not self._is_apart:
            return measured.env_steps_per_s
        rates = measured.acting_per_s, measured.learning_per_s
        return measured.env_steps_per_s * per_gpu(*rates) / min(rates)

    def split(self, measured: Measured) -> Split | None:
        """See `Workload`."""
        if not self._is_apart:
            return None
        if self._given.serving_gpus is not None or self._given.training_gpus is not None:
            return self._counts
        return balance(sum(self._counts), measured.acting_per_s, measured.learning_per_s)

    def settled_plan(self, point: Point, split: Split | None) -> PlanConfig:
        """See `Workload`."""
        plan = _with_gmis(self.config.plan, point)
        if split is None or plan.serving_gpus is not None:
            return plan
        return dataclasses.replace(plan, serving_gpus=split.serving, training_gpus=split.training)


def throughput(split: Split, acting_per_s: float, learning_per_s: float) -> float:
    """Environment steps a second that are made and learnt from, given those of one GPU each."""
    return min(split.serving * acting_per_s, split.training * learning_per_s)


def balance(num_gpus: int, acting_per_s: float, learning_per_s: float) -> Split:
    """The split of `num_gpus` with the highest throughput; of equals that with most serving GPUs.

    Raises:
      ValueError: fewer than two GPUs.
    """
    if num_gpus < 2:
        raise ValueError(f"num_gpus={num_gpus}: one GPU cannot be split")
    splits = [Split(num_gpus - training, training) for training in range(1, num_gpus)]
    return max(splits, key=lambda split: throughput(split, acting_per_s, learning_per_s))


def per_gpu(acting_per_s: float, learning_per_s: float) -> float:
    """Environment steps a second for each GPU of very many, of which the best part trains.

    A job with x of its GPUs training balances where (1 - x) acting = x learning.
    """
    return acting_per_s * learning_per_s / (acting_per_s + learning_per_s)


def _with_gmis(plan: PlanConfig, point: Point) -> PlanConfig:
    """The plan with the acting and training GMIs of a point on every GPU that acts or trains."""
    return dataclasses.replace(
        plan,
        gmis_per_gpu=1,
        serving_gmis_per_gpu=point.gmis_per_gpu,
        training_gmis_per_gpu=point.trainers,
    )


def _without_auto(plan: PlanConfig) -> PlanConfig:
    """The plan as if nothing were `auto` in it; raises ConfigError for a number that is given."""
    if plan.gmis_per_gpu != AUTO:
        return plan
    if (value := plan.num_serving_gmis) != 1:
        raise ConfigError(
            f"plan.serving_gmis_per_gpu={value}: is searched for with plan.gmis_per_gpu=auto; "
            f"give search.gmis_per_gpu=[{value}], or plan.gmis_per_gpu=1 to have it as it is"
        )
    return dataclasses.replace(plan, gmis_per_gpu=1)


def _is_apart(
    serving: Sequence[int], training: Sequence[int], indices: tuple[int, ...] | None
) -> bool:
    """Whether no GPU both acts and trains; that some do is refused."""
    both = {*serving} & {*training}
    if both and {*serving} != {*training}:
        named = [indices[i] if indices else i for i in sorted(both)]
        raise ConfigError(
            f"plan.serving_gpus, plan.training_gpus: GPUs {named} both act and train and others "
            "do not: nothing can be found for such jobs; let all do both or none, or give numbers"
        )
    return not both
