"""Algorithm 2 for asynchronous training: how many GMIs act and train, on how many GPUs. No jax.

A profile is a real job, on one GPU where every GPU of the job acts and trains, else on one that
acts and one that trains. How the GPUs of a job are divided then follows from what each can do
(`gmijax.partition.balance`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, Final, NamedTuple

from gmijax.config import AUTO, PlanConfig, TrainConfig
from gmijax.control.async_profile import Enough, read
from gmijax.control.decoupled import plan_decoupled
from gmijax.control.kinds import Decoupled
from gmijax.control.workload import Workload
from gmijax.errors import ConfigError
from gmijax.partition.balance import Split, balance, per_gpu, throughput
from gmijax.partition.machine import Machine
from gmijax.partition.placement import place, serving_and_training
from gmijax.partition.plan import Plan
from gmijax.partition.points import Measured, Point
from gmijax.partition.search import top_of_one
from gmijax.schema import to_dict

_ENDLESS_STEPS: Final = 10**15


def decoupled_training(config: TrainConfig) -> Workload:
    """Asynchronous training as a workload.

    Raises:
      ConfigError: a job that the search cannot profile, or a placement that cannot be.
    """
    if config.search.mode != "corun":
        raise ConfigError(
            f"search.mode={config.search.mode}: with algo=a3c allowed is corun, because agents "
            "and trainers do nothing without each other"
        )
    given = _without_auto(config.plan)
    place(given)
    serving, training, indices = serving_and_training(given)
    sides = _Sides(
        num_serving=len(serving),
        num_training=len(training),
        is_apart=_is_apart(serving, training, indices),
        is_open=given.serving_gpus is None and given.training_gpus is None,
    )
    is_auto = config.plan.gmis_per_gpu == AUTO
    gmis_per_gpu = AUTO if is_auto else given.serving_gmis_per_gpu
    return Workload(
        env=config.env,
        plan=_of_device(given, gmis_per_gpu, indices or len({*serving, *training})),
        reduce=config.reduce,
        num_envs=config.num_envs,
        impl=config.physics.impl,
        template="decoupled",
        kind=Decoupled(config),
        config_at=partial(_config_at, config),
        read=partial(read, config.search.iterations),
        key={
            "job": "train",
            "algo": to_dict(config.algo),
            "channel": to_dict(config.channel),
            "placement": "apart" if sides.is_apart else "together",
            "iterations": config.search.iterations,
        },
        trainers=(
            config.search.training_gmis_per_gpu if is_auto else (given.training_gmis_per_gpu,)
        ),
        plan_of=partial(_plan_of, config, _profiled_on(given, is_apart=sides.is_apart)),
        is_enough=partial(Enough, config),
        estimate=sides.estimate,
        top=_top_apart if sides.is_apart else top_of_one,
        split=sides.split,
    )


class _Sides(NamedTuple):
    """GPUs that act and GPUs that train.

    Attributes:
      num_serving, num_training: how many.
      is_apart: every one does one of both.
      is_open: their division is for the search to find.
    """

    num_serving: int
    num_training: int
    is_apart: bool
    is_open: bool

    def split(self, measured: Measured) -> Split | None:
        """How the GPUs are divided after a profile; None where all do both."""
        if not self.is_apart:
            return None
        if not self.is_open:
            return Split(self.num_serving, self.num_training)
        num_gpus = self.num_serving + self.num_training
        return balance(num_gpus, measured.acting_per_s, measured.learning_per_s)

    def estimate(self, point: Point, measured: Measured) -> float:
        """What the whole job would make, environment steps per second."""
        profiled = point.gmis_per_gpu * measured.env_steps_per_s
        split = self.split(measured)
        if split is None:
            return self.num_serving * profiled
        rates = measured.acting_per_s, measured.learning_per_s
        # Each side waits now and then although the other is the slower one: so in the profile.
        return profiled * throughput(split, *rates) / min(rates)


def settled(plan: PlanConfig, serving: int, training: int, split: Split | None) -> PlanConfig:
    """The plan of a job with what a search has found.

    Args:
      plan: the user's wishes.
      serving: acting GMIs on every GPU that acts.
      training: training GMIs on every GPU that trains.
      split: how many GPUs do what; None: as the user wishes.
    """
    plan = dataclasses.replace(
        plan, gmis_per_gpu=1, serving_gmis_per_gpu=serving, training_gmis_per_gpu=training
    )
    if split is None or plan.serving_gpus is not None:
        return plan
    return dataclasses.replace(plan, serving_gpus=split.serving, training_gpus=split.training)


def _without_auto(plan: PlanConfig) -> PlanConfig:
    """The plan as if nothing were `auto` in it.

    Raises:
      ConfigError: numbers of GMIs are given, and to be searched for too.
    """
    if plan.gmis_per_gpu != AUTO:
        return plan
    for key, where in (
        ("serving_gmis_per_gpu", "search.gmis_per_gpu"),
        ("training_gmis_per_gpu", "search.training_gmis_per_gpu"),
    ):
        if (value := getattr(plan, key)) != 1:
            raise ConfigError(
                f"plan.{key}={value}: is searched for with plan.gmis_per_gpu=auto; give "
                f"{where}=[{value}], or plan.gmis_per_gpu=1 to have plan.serving_gmis_per_gpu "
                "and plan.training_gmis_per_gpu as they are"
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


def _of_device(plan: PlanConfig, gmis_per_gpu: Any, gpus: int | tuple[int, ...]) -> PlanConfig:
    """The plan with its GPUs in one place, and without what a profile does not depend on."""
    return dataclasses.replace(
        plan,
        gpus=gpus,
        gmis_per_gpu=gmis_per_gpu,
        serving_gpus=None,
        training_gpus=None,
        serving_gmis_per_gpu=1,
        training_gmis_per_gpu=1,
    )


def _profiled_on(plan: PlanConfig, *, is_apart: bool) -> PlanConfig:
    """One GPU of the job that does both, or one that acts and one that trains."""
    serving, training, indices = serving_and_training(plan)
    if not is_apart:
        gpus = 1 if indices is None else (indices[serving[0]],)
        return dataclasses.replace(plan, gpus=gpus, serving_gpus=None, training_gpus=None)
    if indices is None:
        return dataclasses.replace(plan, gpus=2, serving_gpus=1, training_gpus=1)
    acts, trains = indices[serving[0]], indices[training[0]]
    return dataclasses.replace(
        plan, gpus=(acts, trains), serving_gpus=(acts,), training_gpus=(trains,)
    )


def _config_at(config: TrainConfig, point: Point, num_gmis: int) -> TrainConfig:
    del num_gmis
    return dataclasses.replace(
        config,
        num_envs=point.num_envs,
        num_timesteps=_ENDLESS_STEPS,  # It ends when there is enough to read.
        physics=dataclasses.replace(config.physics, impl=point.impl),
        run=dataclasses.replace(config.run, resume=None, checkpoint_every=0),
    )


def _plan_of(config: TrainConfig, plan: PlanConfig, point: Point, machine: Machine) -> Plan:
    plan = settled(plan, point.gmis_per_gpu, point.trainers, None)
    return plan_decoupled(dataclasses.replace(config, plan=plan), point.num_envs, machine)


def _top_apart(measured: Measured) -> float:
    """What Sat goes by where GPUs act and train apart: whichever side is the slower one."""
    rates = measured.acting_per_s, measured.learning_per_s
    return measured.env_steps_per_s * per_gpu(*rates) / min(rates)
