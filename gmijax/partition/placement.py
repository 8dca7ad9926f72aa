"""Where serving and training GMIs of an asynchronous job live (paper, sec. 5.1, decoupled).

Trainers have the lowest ids, so that GMI 0 is the one that leads them and writes the metrics.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from gmijax.config import PlanConfig
from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout

_TRAINING_SHARE = 4
"""With several GPUs one in four trains, at least one: physics takes much longer than updates."""


class Placement(NamedTuple):
    """Which GMIs an asynchronous job has."""

    plan: PlanConfig  # What the user requested, with GPUs and layout written out.
    trainers: tuple[int, ...]  # Ids of the GMIs that train.
    reason: str  # What was decided, in words.


def place(plan: PlanConfig, num_nodes: int = 1) -> Placement:
    """Decides which GPUs serve and which train, and numbers their GMIs.

    On several nodes `plan.gpus` is of each, and the GPUs of all of them count on from node to
    node, as if they were of one machine.

    `plan.serving_gpus` and `plan.training_gpus` are both numbers of GPUs, of which the first
    serve and the next train, or both lists of indices; a GPU in both lists does both. Without
    them one GPU does both, and of several the last quarter (at least one) trains.

    Raises:
      ConfigError: no serving or no training GMI, or settings that contradict each other.
    """
    if plan.layout is not None:
        raise ConfigError(
            f"plan.layout={[list(g) for g in plan.layout]}: with the decoupled template give "
            "plan.serving_gpus and plan.training_gpus, and the GMIs on each"
        )
    serving_gmis, training_gmis = _counts(plan)
    if num_nodes > 1:
        plan = dataclasses.replace(plan, gpus=plan.num_gpus * num_nodes)
    serving, training, indices = serving_and_training(plan)
    num_gpus = 1 + max(*serving, *training)
    if num_nodes > 1:
        _require_whole_nodes(num_gpus, indices, num_nodes)
    layout: list[list[int]] = [[] for _ in range(num_gpus)]
    homes = [gpu for gpu in training for _ in range(training_gmis)]
    trainers = tuple(range(len(homes)))
    homes += [gpu for gpu in serving for _ in range(serving_gmis)]
    for gmi, gpu in enumerate(homes):
        layout[gpu].append(gmi)
    placed = dataclasses.replace(
        plan,
        gpus=num_gpus if indices is None or num_nodes > 1 else indices,
        gmis_per_gpu=1,
        layout=tuple(map(tuple, layout)),
        serving_gpus=None,
        training_gpus=None,
    )
    reason = (
        f"placement: {serving_gmis} serving GMIs on each of GPUs {_shown(serving, indices)}, "
        f"{training_gmis} training GMIs on each of GPUs {_shown(training, indices)}"
    )
    return Placement(placed, trainers, reason)


def most_gmis_of_a_node(plan: PlanConfig, num_nodes: int) -> int:
    """How many GMIs of an asynchronous job the fullest of so many nodes has.

    Raises:
      ConfigError: as `place`.
    """
    rows = place(plan, num_nodes).plan.layout
    assert rows is not None
    return max(map(len, Layout(rows, num_nodes).gmis_of_node))


def on_fewer_nodes(plan: PlanConfig, before: int, num_nodes: int) -> PlanConfig:
    """The requested plan for as many nodes as are left, where all of them did the same.

    Raises:
      ConfigError: indices of GPUs that differ from node to node.
    """
    serving, training, each = plan.serving_gpus, plan.training_gpus, plan.num_gpus
    if num_nodes >= before or not (isinstance(serving, tuple) and isinstance(training, tuple)):
        return plan

    def of_node(node: int) -> list[set[int]]:
        return [{i % each for i in which if i // each == node} for which in (serving, training)]

    if any(of_node(node) != of_node(0) for node in range(before)):
        raise ConfigError(
            f"plan.serving_gpus={list(serving)}, plan.training_gpus={list(training)}: are for "
            f"{before} nodes that do not all do the same, and {num_nodes} are left"
        )
    left = [tuple(i for i in which if i < each * num_nodes) for which in (serving, training)]
    return dataclasses.replace(plan, serving_gpus=left[0], training_gpus=left[1])


def _require_whole_nodes(num_gpus: int, indices: tuple[int, ...] | None, num_nodes: int) -> None:
    last = num_gpus - 1 if indices is None else max(indices)
    if last != num_gpus - 1 or num_gpus % num_nodes:
        raise ConfigError(
            f"plan.serving_gpus, plan.training_gpus: take {num_gpus} GPUs, the last is number "
            f"{last}; on {num_nodes} nodes every node must have as many, and each act or train"
        )


def num_gmis_of(plan: PlanConfig) -> tuple[int, str]:
    """How many GMIs a job has, and the settings that say so; before they are numbered.

    Raises:
      ConfigError: as `place`.
    """
    serving_gmis, training_gmis = _counts(plan)
    serving, training, _ = serving_and_training(plan)
    what = f"plan.serving_gmis_per_gpu={serving_gmis}, plan.training_gmis_per_gpu={training_gmis}"
    return len(serving) * serving_gmis + len(training) * training_gmis, what


def _counts(plan: PlanConfig) -> tuple[int, int]:
    if plan.gmis_per_gpu != 1:
        raise ConfigError(
            f"plan.gmis_per_gpu={plan.gmis_per_gpu}: with the decoupled template give "
            "plan.serving_gmis_per_gpu and plan.training_gmis_per_gpu"
        )
    counts = plan.num_serving_gmis, plan.training_gmis_per_gpu
    for key, what, count in zip(("serving", "training"), ("act", "train"), counts, strict=True):
        if count < 1:
            raise ConfigError(
                f"plan.{key}_gmis_per_gpu={count}: at least one GMI must {what}, so at least 1"
            )
    return counts


def serving_and_training(
    plan: PlanConfig,
) -> tuple[list[int], list[int], tuple[int, ...] | None]:
    """Positions of the GPUs that serve and that train, and the machine's indices if given.

    Raises:
      ConfigError: as `place`.
    """
    named = None if isinstance(plan.gpus, int) else plan.gpus
    serving, training = plan.serving_gpus, plan.training_gpus
    if serving is None and training is None:
        if plan.num_gpus == 1:
            return [0], [0], named
        training = max(1, plan.num_gpus // _TRAINING_SHARE)
        serving = plan.num_gpus - training
    for key, value in (("serving_gpus", serving), ("training_gpus", training)):
        if value is None or not value or (isinstance(value, int) and value < 1):
            raise ConfigError(
                f"plan.{key}={'null' if value is None else value}: there must be serving and "
                "training GPUs; give both keys, numbers of at least 1 or lists of indices"
            )
    if isinstance(serving, tuple) and isinstance(training, tuple):
        return _by_index(serving, training, named)
    if not (isinstance(serving, int) and isinstance(training, int)):
        raise ConfigError(
            f"plan.serving_gpus={serving}, plan.training_gpus={training}: expected two numbers "
            "or two lists of indices"
        )
    total = serving + training
    if named is not None and len(named) != total:
        raise ConfigError(
            f"plan.gpus={list(named)}: plan.serving_gpus={serving} and "
            f"plan.training_gpus={training} take {total}"
        )
    return list(range(serving)), list(range(serving, total)), named


def _by_index(
    serving: tuple[int, ...], training: tuple[int, ...], named: tuple[int, ...] | None
) -> tuple[list[int], list[int], tuple[int, ...]]:
    for key, value in (("serving_gpus", serving), ("training_gpus", training)):
        if len(set(value)) != len(value) or min(value) < 0:
            raise ConfigError(f"plan.{key}={list(value)}: expected distinct indices of GPUs")
    indices = tuple(sorted({*serving, *training}))
    if named is not None and set(named) != set(indices):
        raise ConfigError(
            f"plan.gpus={list(named)}: plan.serving_gpus and plan.training_gpus name "
            f"{list(indices)}"
        )
    return [indices.index(i) for i in serving], [indices.index(i) for i in training], indices


def _shown(positions: list[int], indices: tuple[int, ...] | None) -> list[int]:
    return [indices[i] if indices else i for i in positions]
