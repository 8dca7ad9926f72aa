"""What the keys of a sweep may be: lists of values, or intervals to draw from."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

from gmijax.errors import ConfigError

MAX_JOBS = 10_000
"""More would be a slip of the keyboard."""


class Choices(NamedTuple):
    """Values as they stand in overrides."""

    values: tuple[str, ...]


class Interval(NamedTuple):
    """Numbers from `low` to `high`.

    Attributes:
      low, high: both can be drawn.
      is_log: drawn evenly by their logarithm.
      is_integer: whole numbers only.
    """

    low: float
    high: float
    is_log: bool = False
    is_integer: bool = False


Space: TypeAlias = Mapping[str, Choices | Interval]


def grid(space: Space, command: str = "sweep") -> list[dict[str, str]]:
    """Every combination of values, the last key changing fastest.

    Raises:
      ConfigError: an interval, or too many.
    """
    lists: dict[str, tuple[str, ...]] = {}
    for key, values in space.items():
        if isinstance(values, Interval):
            raise ConfigError(
                f"{key}: an interval has no list of values; use {command}.sampler=random or tpe, "
                "or give values"
            )
        lists[key] = values.values
    require_few_jobs(" ".join(lists), math.prod(map(len, lists.values())))
    return [dict(zip(lists, values, strict=True)) for values in itertools.product(*lists.values())]


def require_few_jobs(keys: str, num_jobs: int) -> None:
    """Raises ConfigError if `keys` ask for more jobs than `MAX_JOBS`; before a list is made."""
    if num_jobs > MAX_JOBS:
        raise ConfigError(f"{keys}: {num_jobs:,} jobs; at most {MAX_JOBS:,} are allowed")


def corners(space: Space) -> list[dict[str, str]]:
    """Points that have every value of every list and both ends of every interval.

    Where fractions may be drawn they have one too: both ends may be whole numbers.
    """
    columns = {
        key: values.values if isinstance(values, Choices) else _some_of(values)
        for key, values in space.items()
    }
    most = max(map(len, columns.values()), default=1)
    return [
        {key: values[min(k, len(values) - 1)] for key, values in columns.items()}
        for k in range(most)
    ]


def _some_of(interval: Interval) -> tuple[str, ...]:
    low, high = interval.low, interval.high
    between = () if interval.is_integer else (low + (high - low) / math.pi,)
    return tuple(as_text(value, interval) for value in (low, high, *between))


def as_text(value: float, interval: Interval) -> str:
    """A number of an interval as it stands in an override."""
    return str(int(value)) if interval.is_integer else repr(float(value))
