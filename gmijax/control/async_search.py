"""Algorithm 2 for asynchronous training: how many GMIs act and train, on how many GPUs. No jax.

A profile is a real job, on one GPU where every GPU of the job acts and trains, else on one that
acts and one that trains. How the GPUs of a job are divided then follows from what each can do
(`gmijax.partition.balance`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Final

from gmijax.config import AUTO, A3cConfig, PlanConfig, TrainConfig
from gmijax.control.decoupled import MODULE, groups_of, plan_decoupled, shared_blocks
from gmijax.control.workload import Workload, peak_memory_mib
from gmijax.errors import ConfigError
from gmijax.partition.balance import Split, balance, per_gpu, throughput
from gmijax.partition.gmi_process import GmiStatus
from gmijax.partition.machine import Machine
from gmijax.partition.placement import place, serving_and_training
from gmijax.partition.plan import Plan
from gmijax.partition.points import Measured, Point
from gmijax.partition.search import top_of_one
from gmijax.results import read_metrics
from gmijax.rundir import RunPaths, read_json
from gmijax.schema import to_dict

FEWEST_LINES: Final = 3
"""Lines of metrics that a profile goes by, each of half a second or of one batch."""

MOST_IDLE: Final = 0.95
"""Agents that wait longer than this part of their time say little of what they could do."""

_ENDLESS_STEPS: Final = 10**15

Line = Mapping[str, Any]


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
    is_apart = _is_apart(serving, training, indices)
    is_auto = config.plan.gmis_per_gpu == AUTO
    is_open = given.serving_gpus is None and given.training_gpus is None

    def split_of(measured: Measured) -> Split | None:
        if not is_apart:
            return None
        if not is_open:
            return Split(len(serving), len(training))
        num_gpus = len(serving) + len(training)
        return balance(num_gpus, measured.acting_per_s, measured.learning_per_s)

    def estimate(point: Point, measured: Measured) -> float:
        split = split_of(measured)
        if split is None:
            return len(serving) * point.gmis_per_gpu * measured.env_steps_per_s
        profiled = point.gmis_per_gpu * measured.env_steps_per_s
        rates = measured.acting_per_s, measured.learning_per_s
        # Each side waits now and then although the other is the slower one: so in the profile.
        return profiled * throughput(split, *rates) / min(rates)

    gmis_per_gpu = AUTO if is_auto else given.serving_gmis_per_gpu
    return Workload(
        env=config.env,
        plan=_of_device(given, gmis_per_gpu, indices or len({*serving, *training})),
        reduce=config.reduce,
        num_envs=config.num_envs,
        impl=config.physics.impl,
        template="decoupled",
        module=MODULE,
        config_at=partial(_config_at, config),
        read=partial(_read, config.search.iterations),
        key={
            "job": "train",
            "algo": to_dict(config.algo),
            "channel": to_dict(config.channel),
            "placement": "apart" if is_apart else "together",
            "iterations": config.search.iterations,
        },
        trainers=(
            config.search.training_gmis_per_gpu if is_auto else (given.training_gmis_per_gpu,)
        ),
        plan_of=partial(_plan_of, config, _profiled_on(given, is_apart=is_apart)),
        compile_once=False,
        shared=partial(shared_blocks, config),
        is_enough=partial(Enough, config),
        estimate=estimate,
        top=_top_apart if is_apart else top_of_one,
        split=split_of,
    )


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


class Enough:
    """Whether a profile can be read: enough was done since its channels had filled.

    Agents compile for different times, and until the channels are full they never wait: nothing
    that is counted before tells of a long job.

    Args:
      config: of the job.
      plan: of the profile.
      run: its folder.
    """

    def __init__(self, config: TrainConfig, plan: Plan, run: RunPaths) -> None:
        agents, trainers = groups_of(plan)
        self._iterations = config.search.iterations
        self._agents = agents.gmis
        assert isinstance(config.algo, A3cConfig)
        # Those that may wait for every trainer, one on its way, and one that is being made.
        self._unrolls = config.algo.max_ahead * len(trainers.gmis) + 2
        self._metrics = run.metrics
        self._first: int | None = None

    def __call__(self, gmis: Sequence[GmiStatus]) -> bool:
        """Whether it can, with the GMIs as they are now."""
        if not all(
            one.state == "running"
            and one.iteration >= (self._unrolls if one.gmi in self._agents else 1)
            for one in gmis
        ):
            return False
        lines = read_metrics(self._metrics)
        if self._first is None:
            self._first = len(lines) + 1  # The line that has begun does not count.
        start = window_start(lines[:-1], self._iterations)
        return start is not None and start >= self._first


def window_start(lines: Sequence[Line], iterations: int) -> int | None:
    """Index of the first of the latest lines that hold what a profile goes by; None: too few.

    The line before it is needed too, because lines tell when they end. Something was made in
    them: where an unroll is many batches, agents can be silent for many lines.

    Args:
      lines: of `metrics.jsonl`.
      iterations: batches that they are to have at least.
    """
    batches = made = 0.0
    for start in range(len(lines) - 1, 0, -1):
        batches += lines[start]["async/updates"]
        made += lines[start]["async/pps"]
        if made > 0 and batches >= iterations and len(lines) - start >= FEWEST_LINES:
            return start
    return None


def measured_of(lines: Sequence[Line], num_agents: int, memory_mib: float) -> Measured:
    """What a profile says of one serving GMI, and of a serving and a training GPU.

    Trainers could learn from TTOP x (update + wait for a batch) / update, agents could make PPS /
    (1 - the part of their time for which they had to wait for room).

    Args:
      lines: those that `window_start` names, and the one before them.
      num_agents: all of them, on one GPU.
      memory_mib: largest peak of any GMI.
    """
    before, *seen = lines
    duration_s = seen[-1]["wall_s"] - before["wall_s"]
    ends_s = [line["wall_s"] for line in lines]
    spans_s = [end - start for start, end in pairwise(ends_s)]
    batches = sum(line["async/updates"] for line in seen)
    pps = sum(s * line["async/pps"] for s, line in zip(spans_s, seen, strict=True)) / duration_s
    ttop = (seen[-1]["env_steps"] - before["env_steps"]) / duration_s
    update_s, receive_s = (
        sum(line["async/updates"] * line[f"time/{what}_s"] for line in seen) / batches
        for what in ("update", "receive")
    )
    idle = sum(line["time/wait_s"] for line in seen) / (num_agents * duration_s)
    return Measured(
        env_steps_per_s=min(pps, ttop) / num_agents,
        memory_mib=memory_mib,
        iteration_s=duration_s / batches,
        acting_per_s=pps / (1.0 - min(idle, MOST_IDLE)),
        learning_per_s=ttop * (update_s + receive_s) / update_s,
    )


def _read(iterations: int, plan: Plan, run: RunPaths) -> Measured:
    lines = read_metrics(run.metrics)[:-1]  # The last may hold the end of the job.
    start = window_start(lines, iterations)
    if start is None:
        raise ValueError(f"{len(lines)} lines of metrics are too few")
    results = [read_json(run.gmi(gmi).result) for gmi in plan.layout.gmis]
    memory_mib = max(peak_memory_mib(one["device"]) for one in results if "device" in one)
    return measured_of(lines[start - 1 :], len(groups_of(plan)[0].gmis), memory_mib)


def _top_apart(measured: Measured) -> float:
    """What Sat goes by where GPUs act and train apart: whichever side is the slower one."""
    rates = measured.acting_per_s, measured.learning_per_s
    return measured.env_steps_per_s * per_gpu(*rates) / min(rates)
