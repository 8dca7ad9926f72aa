"""What jobs of a sweep are ranked by, and how good each is: one definition for all comparisons."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from gmijax.config import TrainConfig
from gmijax.config.schema import suggestion
from gmijax.config.sweep import Ranking, SweepConfig
from gmijax.errors import ConfigError
from gmijax.runs.history import number_in

_RETURN, _EVALUATED = "return", "eval/return"
_EVALUATIONS = "eval/"
_OF_EPISODES = ("return", "episode_length", "reward/", "metric/")
_LAST_PART = 0.1
"""Of the steps so far: what has no window is averaged over them."""


class ObjectiveValue(NamedTuple):
    """The objective in a line of metrics.

    Attributes:
      number: its value there.
      is_full: whether it can be compared: it is no mean over a window that is not full.
      episodes: how many it is a mean over, where that is known.
    """

    number: float
    is_full: bool = True
    episodes: int | None = None


def find(line: Mapping[str, Any], objective: str) -> ObjectiveValue | None:
    """The objective in a line of metrics; None if it has none, or no finite one.

    Means over episodes are those of the long window (`EpisodeWindow`).
    """
    episodes = number_in(line, "window/episodes")
    count = None if episodes is None else int(episodes)
    if (long := number_in(line, f"window/{objective}")) is not None:
        return ObjectiveValue(long, bool(line.get("window/full")), count)
    if (number := number_in(line, objective)) is None:
        return None
    # Of a run of an older version, whose lines do not state over what they are means.
    return ObjectiveValue(number, is_full=not objective.startswith(_OF_EPISODES))


def require_logged(line: Mapping[str, Any], objective: str) -> None:
    """Refuses an objective that is not among the keys of a line of metrics.

    All lines of a run have the same, but for those of evaluations.

    Raises:
      ConfigError: names those that there are.
    """
    if objective in line or (objective.startswith(_EVALUATIONS) and _EVALUATED not in line):
        return
    names = [name for name in line if not name.startswith("window/")]
    group = objective.partition("/")[0]
    of_group = [name for name in names if name.partition("/")[0] == group and "/" in name]
    raise ConfigError(
        f"sweep.objective={objective}: not in the metrics of these jobs"
        f"{suggestion(objective, of_group or names)}"
    )


def value_of(curve: Sequence[tuple[int, float]], ranking: Ranking) -> float:
    """What a job is ranked by after these steps, by environment steps and objective.

    The best evaluation: it has a checkpoint. Of means over episodes the last one, which is over a
    whole window. Of anything else the mean of the last tenth of the steps.
    """
    if ranking.objective.startswith(_EVALUATIONS):
        best = max if ranking.direction == "maximize" else min
        return best(number for _, number in curve)
    if ranking.objective.startswith(_OF_EPISODES):
        return curve[-1][1]
    first = curve[-1][0] * (1.0 - _LAST_PART)
    last = [number for steps, number in curve if steps >= first]
    return sum(last) / len(last)


def with_objective(sweep: SweepConfig, configs: Sequence[TrainConfig]) -> SweepConfig:
    """The settings with the key that jobs are ranked by.

    Raises:
      ConfigError: jobs are to be ranked by evaluations that they do not make.
    """
    objective = sweep.objective.removeprefix("window/")  # Its own is taken in any case.
    all_evaluate = all(config.eval.every is not None for config in configs)
    if objective == "auto":
        objective = _EVALUATED if all_evaluate else _RETURN
    if objective.startswith(_EVALUATIONS) and not all_evaluate:
        raise ConfigError(
            f"sweep.objective={objective}: needs eval.every, environment steps between evaluations"
        )
    return dataclasses.replace(sweep, objective=objective)


def why_not_comparable(configs: Sequence[TrainConfig], sweep: SweepConfig) -> str | None:
    """A warning if jobs are ranked by returns of different rewards, else None."""
    first, *others = (dict(config.env.rewards) for config in configs)
    if sweep.objective not in (_RETURN, _EVALUATED) or all(other == first for other in others):
        return None
    return (
        f"warning: sweep.objective={sweep.objective}: jobs differ in env.rewards, so their "
        "returns cannot be compared; a metric of the task can (sweep.objective=metric/...)"
    )
