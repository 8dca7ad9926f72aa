"""Jobs of a sweep by setting: what seeds of the same one make together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from gmijax.config.sweep import Ranking
from gmijax.sweeps.any_job import label_of

T = TypeVar("T")
Row = Mapping[str, Any]
Values = npt.NDArray[np.float64]

_QUARTILES = (25, 75)


class SeedSummary(NamedTuple):
    """Interquartile mean over seeds, and the quartiles (as rliable has it, arXiv 2108.13264).

    Of two seeds it is their mean, of three their median.
    """

    mean: Values
    low: Values
    high: Values


def seed_summary(values: Values) -> SeedSummary:
    """Of values [K, ...] of K seeds."""
    low, high = np.percentile(values, _QUARTILES, axis=0)
    inside = (values >= low) & (values <= high)
    # Those of two seeds lie between them, and nothing else does.
    inside |= ~inside.any(axis=0)
    return SeedSummary((values * inside).sum(axis=0) / inside.sum(axis=0), low, high)


def name_of_middle(num_seeds: int) -> str:
    """What `seed_summary` takes of so many seeds."""
    return {1: "one seed", 2: "mean", 3: "median"}.get(num_seeds, "interquartile mean")


def without_seed(overrides: Mapping[str, str]) -> dict[str, str]:
    """What makes the setting of a job."""
    return {key: value for key, value in overrides.items() if key.rpartition(".")[2] != "seed"}


def grouped(
    items: Iterable[T], overrides_of: Callable[[T], Mapping[str, str]]
) -> dict[str, list[T]]:
    """Items by setting, in words."""
    found: dict[str, list[T]] = {}
    for item in items:
        label = label_of(without_seed(overrides_of(item))) or "all seeds"
        found.setdefault(label, []).append(item)
    return found


def settings_of(rows: Sequence[Row], ranking: Ranking) -> list[dict[str, Any]]:
    """Settings of the jobs with these rows, the best first.

    Those of which a seed has no full window come after all others, those without any value last.
    """
    found = [_setting(own) for own in grouped(rows, lambda row: row["overrides"]).values()]
    return sorted(
        found, key=lambda setting: sort_key(setting, setting["interquartile_mean"], ranking)
    )


def _setting(rows: Sequence[Row]) -> dict[str, Any]:
    ranked = [row for row in rows if row["value"] is not None]
    middle = seed_summary(np.array([row["value"] for row in ranked])) if ranked else None
    return {
        "overrides": without_seed(rows[0]["overrides"]),
        "jobs": [row["job"] for row in rows],
        "n": len(ranked),
        "interquartile_mean": None if middle is None else float(middle.mean),
        "quartiles": None if middle is None else [float(middle.low), float(middle.high)],
        "window_full": bool(ranked) and all(row["window_full"] for row in ranked),
    }


def sort_key(row: Row, value: float | None, ranking: Ranking) -> tuple[bool, bool, float]:
    """What rows are sorted by: the best one has the smallest."""
    sign = -1.0 if ranking.direction == "maximize" else 1.0
    return value is None, not row["window_full"], sign * (value or 0.0)
