"""Steps per second of runs that are under way: of one, or of several at the same time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from gmijax.runs.folder import RunPaths
from gmijax.runs.history import read_metrics

Curve: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Seconds since the first job started [P], and environment steps by then [P]."""


def curve_of(row: Mapping[str, Any]) -> Curve | None:
    """Of a job of a `sweep.json`; None if it has not trained."""
    lines = read_metrics(RunPaths(Path(row["run_dir"])).metrics)
    if not lines or row["first_update_s"] is None:
        return None
    first_s = row["start_s"] + row["first_update_s"]
    seconds = [first_s + line["wall_s"] - lines[0]["wall_s"] for line in lines]
    return np.array(seconds), np.array([line["env_steps"] for line in lines])


def are_alike(jobs: Sequence[Mapping[str, Any]]) -> bool:
    """Whether jobs of a `pack.json` are of one kind: those that completed made as many steps."""
    steps = [job["env_steps"] for job in jobs if job["state"] == "completed"]
    return not steps or max(steps) <= 1.5 * min(steps)


def rate_of_jobs(jobs: Sequence[Mapping[str, Any]]) -> float | None:
    """Steps per second of all jobs of a pack together; None of a mix, whose sum has no meaning."""
    return sum(job["env_steps_per_s"] or 0.0 for job in jobs) if are_alike(jobs) else None


def settled_rate(curve: Sequence[tuple[float, int]]) -> float | None:
    """Steps per second after the first fifth of one run, which holds compilation.

    Args:
      curve: seconds and environment steps by then, oldest first.

    Returns:
      None where less than two points are behind it.
    """
    kept = [point for point in curve if point[1] >= 0.2 * curve[-1][1]]
    if len(kept) < 2:
        return None
    (first_s, first), (last_s, last) = kept[0], kept[-1]
    return (last - first) / (last_s - first_s)


def steady_rate(curves: Sequence[Curve], at_once: int) -> float | None:
    """Steps per second of all jobs together while at least `at_once` train; None: never."""
    edges = sorted({second for seconds, _ in curves for second in (seconds[0], seconds[-1])})
    total_s = total_steps = 0.0
    for start_s, end_s in pairwise(edges):
        training = [c for c in curves if c[0][0] <= start_s and end_s <= c[0][-1]]
        if len(training) >= at_once:
            total_s += end_s - start_s
            total_steps += sum(
                float(np.interp(end_s, *curve) - np.interp(start_s, *curve)) for curve in training
            )
    return total_steps / total_s if total_s else None
