"""Whether a run succeeded, and how the seeds of one setting compare with those of another.

Pure functions on lines of `metrics.jsonl`. A run has succeeded if it did not lose what it had
learnt, or, where the task has a goal in numbers, if it reaches that in the end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy import stats

Lines: TypeAlias = Sequence[Mapping[str, Any]]
Curve: TypeAlias = Sequence[tuple[int, float, float | None]]
"""Environment steps, seconds and the return of the latest episodes, None before the first."""

WINDOW = 10
"""Iterations over which the reward of a step is averaged: fewer show what noise does."""

LAST_TO_PEAK = 0.9
OPENED = 0.95
_WANTED = {"franka_cabinet": ("metric/opened", OPENED)}
"""Task -> what its last episodes must show, and how much of it, instead of `LAST_TO_PEAK`."""

CURVE_POINTS = 60

HEALTH = (
    "policy/learning_rate_min",
    "policy/learning_rate_max",
    "policy/noise_std_min",
    "loss/saturated_fraction",
    "loss/value_clip_fraction",
    "value/explained_variance",
    "loss/end_atoms",
)
"""What shows a run go wrong (docs/learning.md)."""


class Outcome(NamedTuple):
    """How one training ended.

    Attributes:
      seed: of the training.
      succeeded: see `succeeded`.
      final: reward of a step in the end, None without metrics.
      peak: the highest that it was.
      final_return: of the latest episodes.
      wall_s: seconds from the start of its processes to their end.
      diverged_steps: in all.
      at_end: means over the last iterations of `HEALTH` and of the task's own metrics; of
        evaluations, which act without noise, the last return and the highest.
      curve: see `return_curve`.
    """

    seed: str
    succeeded: bool
    final: float | None
    peak: float | None
    final_return: float | None
    wall_s: float
    diverged_steps: float
    at_end: Mapping[str, float]
    curve: Curve = ()


def smoothed(values: Sequence[float]) -> np.ndarray:
    """Means over `WINDOW` neighbours [P - WINDOW + 1]; over all of them where there are fewer."""
    width = min(WINDOW, len(values))
    return np.convolve(values, np.full(width, 1.0 / width), "valid")


def return_curve(lines: Lines) -> Curve:
    """About `CURVE_POINTS` of the lines, the first and the last one among them."""
    kept = [*lines[:: max(1, len(lines) // CURVE_POINTS)]]
    kept += [] if not lines or kept[-1] is lines[-1] else lines[-1:]
    return [(line["env_steps"], line["wall_s"], line.get("return")) for line in kept]


def seconds_to(mark: float, curve: Curve) -> float | None:
    """From the first line until the return is that high; None if it never is."""
    reached = (at for _, at, found in curve if found is not None and found >= mark)
    return next((at - curve[0][1] for at in reached), None)


def rewards(lines: Lines) -> list[float]:
    """Rewards of a step, in the order of the iterations."""
    return [line["reward_per_step"] for line in lines if line.get("reward_per_step") is not None]


def succeeded(task: str, lines: Lines) -> bool:
    """Whether a training with these metrics succeeded at `task`.

    The goal of the task is reached in at least `OPENED` of the latest episodes; where it has none
    in numbers, the smoothed reward of a step ends at `LAST_TO_PEAK` of its peak or above.
    """
    if task in _WANTED:
        name, least = _WANTED[task]
        return bool(lines) and (lines[-1].get(name) or 0.0) >= least
    curve = smoothed(found) if (found := rewards(lines)) else np.array([-math.inf])
    return bool(math.isfinite(curve[-1]) and curve[-1] >= LAST_TO_PEAK * curve.max())


def outcome_of(
    task: str,
    lines: Lines,
    *,
    seed: str,
    completed: bool,
    wall_s: float,
) -> Outcome:
    """The outcome of a run; one that did not complete has not succeeded."""
    curve = smoothed(found) if (found := rewards(lines)) else None
    names = [*HEALTH, *(name for name in (lines[-1] if lines else {}) if "metric/" in name)]
    evaluations = [line["eval/return"] for line in lines if line.get("eval/return") is not None]
    return Outcome(
        seed,
        completed and succeeded(task, lines),
        None if curve is None else float(curve[-1]),
        None if curve is None else float(curve.max()),
        lines[-1].get("return") if lines else None,
        wall_s,
        sum(line.get("diverged_steps") or 0.0 for line in lines),
        {name: value for name in names if (value := _late_mean(lines, name)) is not None}
        | ({"eval/last": evaluations[-1], "eval/peak": max(evaluations)} if evaluations else {}),
        return_curve(lines),
    )


def _late_mean(lines: Lines, name: str) -> float | None:
    found = [line[name] for line in lines[-WINDOW:] if line.get(name) is not None]
    return float(np.mean(found)) if found else None


def quartiles(values: Sequence[float | None]) -> list[float] | None:
    """[lower quartile, median, upper quartile] of those that are there."""
    found = [value for value in values if value is not None]
    return [float(f"{q:.4g}") for q in np.percentile(found, (25, 50, 75))] if found else None


def wilson(successes: int, count: int) -> list[float] | None:
    """Wilson's interval of 95 % for a share; None of nothing."""
    if not count:
        return None
    interval = stats.binomtest(successes, count).proportion_ci(method="wilson")
    return [round(float(interval.low), 4), round(float(interval.high), 4)]


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """What the seeds of one setting did, for a file of results."""
    successes = sum(one.succeeded for one in outcomes)
    names = dict.fromkeys(name for one in outcomes for name in one.at_end)
    return {
        "seeds": len(outcomes),
        "successes": successes,
        "wilson": wilson(successes, len(outcomes)),
        "final": quartiles([one.final for one in outcomes]),
        "peak": quartiles([one.peak for one in outcomes]),
        "return": quartiles([one.final_return for one in outcomes]),
        "job_wall_s": quartiles([one.wall_s for one in outcomes]),
        "diverged_steps": sum(one.diverged_steps for one in outcomes),
        "at_end": {name: quartiles([o.at_end.get(name) for o in outcomes]) for name in names},
    }


def against(own: Sequence[Outcome], baseline: Sequence[Outcome]) -> dict[str, float | None]:
    """Two-sided p: of as many successes (Fisher), of rewards in the end (Mann-Whitney)."""
    if not own or not baseline:
        return {"p_successes": None, "p_final": None}
    successes = [sum(one.succeeded for one in seeds) for seeds in (own, baseline)]
    table = [successes, [len(own) - successes[0], len(baseline) - successes[1]]]
    finals = [[one.final for one in x if one.final is not None] for x in (own, baseline)]
    p_final = stats.mannwhitneyu(finals[0], finals[1])[1] if all(finals) else None
    return {
        "p_successes": float(f"{stats.fisher_exact(table)[1]:.3g}"),
        "p_final": None if p_final is None else float(f"{p_final:.3g}"),
    }
