"""Algorithm 2 of the paper (section 5.2): which environments per GMI and GMIs per GPU.

Pure rules over a `profile` function that measures one point; `gmijax.autotune.tuner` gives it
one that runs training jobs, tests give it a formula. What the lines of the paper became:

- 2, 4: every number of GMIs, 10 ... 1, with every num_env, 128 ... 16384. The same grid; first
  every third row with the largest size and the third below it, then the neighbours of the best
  point, until none of them is better.
- 5: `profile` returns whether a point runs, its throughput and memory. The same, and physics
  implementations are a further dimension.
- 6-8: what cannot run is skipped. The same.
- 9-12: the first point of a row that runs starts the comparison and is no candidate. Here it is
  one: it was measured, and a row may have no other.
- 13-16: Sat = R_top / R_mem, against the last point of the row that ran. The same; where memory
  did not grow, Sat is infinite with a gain and 0 without.
- 18-19: Sat < alpha ends the row, and that point is no candidate. The row ends here too, but the
  point is a candidate: a gain below alpha is still one.
- 20: `estimate`, which the paper does not print, is `estimate` below; `Rules.estimate` is another
  where GPUs act and train apart (`gmijax.autotune.async_workload`).
- 21-24: the highest projection wins. Here the simplest does of those within `TOLERANCE` of it:
  with the fewest GMIs, then with the fewest environments.

As it is printed it is in `gmijax.baselines.algorithm2`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Final, NamedTuple

from gmijax.autotune.grid import (
    Grid,
    Measured,
    NotRunnable,
    Point,
    coarse,
    neighbours,
)

ALPHA: Final = 0.1
"""A row ends when Sat falls below it: the paper has below 0.1."""

TOLERANCE: Final = 0.02
"""Relative difference of throughput that counts as none."""

_CLEARLY_SLOWER: Final = 0.9
"""An implementation that makes less than this of another in the first row is left alone."""


class OutOfBudget(Exception):
    """Raised by a profile function when there is no time left to measure a point."""


Profile = Callable[[Point], Measured | NotRunnable]
"""What one GMI did at a point, or why it cannot; may raise OutOfBudget."""


class Rules(NamedTuple):
    """How the grid is searched."""

    # Environment steps a second of the whole job, line 20.
    estimate: Callable[[Point, Measured], float]
    top: Callable[[Measured], float]  # What Sat goes by.


class SearchPoint(NamedTuple):
    """A point that was looked at."""

    point: Point
    result: Measured | NotRunnable  # What it did, or why it cannot run.
    saturation: float | None  # Sat, None for the first of its row that ran.
    projected: float  # Environment steps a second of the whole job; 0 where it cannot run.


class SearchOutcome(NamedTuple):
    """Result of a search."""

    visited: tuple[SearchPoint, ...]  # All points that were looked at, in order.
    best: SearchPoint | None  # The best of them, None where nothing ran.
    complete: bool  # Whether the search ended by its rules, and not for want of time.


def saturation(before: Measured, now: Measured, top: Callable[[Measured], float]) -> float:
    """Sat, lines 13 to 15: relative gain of throughput per relative growth of memory."""
    gain = (top(now) - top(before)) / top(before)
    growth = (now.memory_mib - before.memory_mib) / before.memory_mib
    if growth <= 0:  # Nothing is paid: any gain is welcome, and without one there is no point.
        return math.inf if gain > 0 else 0.0
    return gain / growth


def estimate(gmis_per_gpu: int, num_gpus: int, measured: Measured) -> float:
    """Environment steps a second of the whole job, line 20.

    GMIs x GPUs x throughput of one GMI, less what gradients cost that cross GPUs: the exchange of
    t GMIs on one GPU was measured, and by the cost model of MPR (section 4.1, Table 2) it grows
    with 2 (k - 1) / k, from k = t to k = t GPUs. With one GMI a GPU no exchange was measured, so
    that the projection to several GPUs is an upper limit.
    """
    total = gmis_per_gpu * num_gpus
    together = total * measured.env_steps_per_s
    if num_gpus == 1 or gmis_per_gpu == 1 or not measured.reduce_s:
        return together
    growth = ((total - 1) / total) / ((gmis_per_gpu - 1) / gmis_per_gpu)
    longer_s = measured.iteration_s + measured.reduce_s * (growth - 1.0)
    return together * measured.iteration_s / longer_s


def search(grid: Grid, profile: Profile, rules: Rules) -> SearchOutcome:
    """Looks for the point with the highest projected throughput."""
    book = _Measurements(profile, rules)
    complete = True
    try:
        _first_look(book, grid)
        _climb(book, grid)
    except OutOfBudget:
        complete = False
    return SearchOutcome(tuple(book.visited.values()), best(book.visited), complete)


def best(visited: Mapping[Point, SearchPoint]) -> SearchPoint | None:
    """Lines 21 to 24: the simplest of the points that are within `TOLERANCE` of the highest."""
    runnable = [one for one in visited.values() if isinstance(one.result, Measured)]
    if not runnable:
        return None
    highest = max(one.projected for one in runnable)
    good = [one for one in runnable if one.projected >= highest * (1.0 - TOLERANCE)]

    def simplest_first(one: SearchPoint) -> tuple[float, ...]:
        point = one.point
        return (point.gmis_per_gpu + point.trainers, point.num_envs, -one.projected)

    return min(good, key=simplest_first)


class _Measurements:
    """Points measured so far; measures no point twice."""

    def __init__(self, profile: Profile, rules: Rules) -> None:
        self.visited: dict[Point, SearchPoint] = {}
        self.rules = rules
        self._profile = profile

    def visit(self, point: Point) -> SearchPoint:
        """Measures a point, if it was not, and compares it with its row."""
        if point not in self.visited:
            result = self._profile(point)
            projected, sat = 0.0, None
            if isinstance(result, Measured):
                projected = self.rules.estimate(point, result)
                before = self._before(point)
                sat = None if before is None else saturation(before, result, self.rules.top)
            self.visited[point] = SearchPoint(point, result, sat, projected)
        return self.visited[point]

    def is_saturated(self, one: SearchPoint) -> bool:
        """Line 18."""
        return one.saturation is not None and one.saturation < ALPHA

    def has_ended(self, point: Point) -> bool:
        """Whether the point's row ended, by saturation, at a smaller size."""
        return any(self.is_saturated(one) for one in self._smaller(point))

    def best(self) -> SearchPoint | None:
        """Lines 21 to 24, so far."""
        return best(self.visited)

    def _before(self, point: Point) -> Measured | None:
        """The last point of the row, before this one, that ran."""
        ran = [
            (one.point.num_envs, one.result)
            for one in self._smaller(point)
            if isinstance(one.result, Measured)
        ]
        return max(ran, key=lambda item: item[0])[1] if ran else None

    def _smaller(self, point: Point) -> Iterator[SearchPoint]:
        for other, one in self.visited.items():
            is_same_row = other._replace(num_envs=point.num_envs) == point
            if is_same_row and other.num_envs < point.num_envs:
                yield one


def _rows(book: _Measurements, grid: Grid) -> None:
    """Lines 2 to 26 over a grid, in its order."""
    for impl, gmis_per_gpu in product(grid.impls, grid.gmis_per_gpu):
        for num_envs in grid.num_envs:
            if book.is_saturated(book.visit(Point(gmis_per_gpu, num_envs, impl, grid.trainers))):
                break


def _first_look(book: _Measurements, grid: Grid) -> None:
    """The coarse rows; smaller sizes only as long as nothing runs.

    An implementation that is clearly slower in the first row did not catch up where both were
    measured, and a profile takes half a minute.
    """
    sizes = grid.num_envs
    while sizes and book.best() is None:
        part = coarse(grid._replace(num_envs=sizes))
        _rows(book, part._replace(gmis_per_gpu=part.gmis_per_gpu[:1]))
        _rows(book, part._replace(impls=_worth_more(book, grid.impls)))
        sizes = tuple(size for size in sizes if size < part.num_envs[0])


def _worth_more(book: _Measurements, impls: Sequence[str]) -> tuple[str, ...]:
    """The implementations that are not clearly slower than another, as far as is known."""
    highest = dict.fromkeys(impls, 0.0)
    for point, one in book.visited.items():
        highest[point.impl] = max(highest[point.impl], one.projected)
    least = _CLEARLY_SLOWER * max(highest.values())
    return tuple(impl for impl in impls if highest[impl] >= least)


def _climb(book: _Measurements, grid: Grid) -> None:
    """Measures the neighbours of the best point until all of them are known."""
    while (top := book.best()) is not None:
        fresh = [
            point
            for point in neighbours(top.point, grid)
            if point not in book.visited and not book.has_ended(point)
        ]
        if not fresh:
            return
        book.visit(fresh[0])
