"""`search.order=as_printed`: Algorithm 2 of the paper (section 5.2) as it is printed.

Physics implementations are a further loop around it. `gmijax.autotune.search` lists what it does
differently, line by line.
"""

from __future__ import annotations

from gmijax.autotune.grid import Grid, Measured, NotRunnable, Point
from gmijax.autotune.search import (
    ALPHA,
    OutOfBudget,
    Profile,
    Rules,
    SearchOutcome,
    SearchPoint,
    saturation,
)
from gmijax.errors import ConfigError


def search(grid: Grid, profile: Profile, rules: Rules) -> SearchOutcome:
    """Goes through the whole grid, from the most GMIs down and from the smallest size up.

    Raises:
      ConfigError: no row has a second point that runs and gains: the first only starts the
        comparison (lines 9 to 12).
    """
    visited: list[SearchPoint] = []
    candidates: list[SearchPoint] = []
    is_complete = True
    try:
        for impl in grid.impls:
            for gmis_per_gpu in sorted(grid.gmis_per_gpu, reverse=True):  # Line 2.
                row = [
                    Point(gmis_per_gpu, num_envs, impl, grid.trainers)
                    for num_envs in sorted(grid.num_envs)
                ]
                _search_row(row, profile, rules, visited, candidates)
    except OutOfBudget:
        is_complete = False
    if not candidates and any(isinstance(one.result, Measured) for one in visited):
        raise ConfigError(
            "search.order=as_printed: no point is a candidate, because the first of a row that "
            "runs only starts the comparison; give more sizes in search.num_envs"
        )
    best = max(candidates, key=lambda one: one.projected, default=None)  # Lines 21 to 24.
    return SearchOutcome(tuple(visited), best, is_complete)


def _search_row(
    row: list[Point],
    profile: Profile,
    rules: Rules,
    visited: list[SearchPoint],
    candidates: list[SearchPoint],
) -> None:
    """Lines 4 to 26."""
    before: Measured | None = None
    for point in row:
        result = profile(point)  # Line 5.
        if isinstance(result, NotRunnable):  # Lines 6 to 8.
            visited.append(SearchPoint(point, result, None, 0.0))
            continue
        projected = rules.estimate(point, result)  # Line 20.
        if before is None:  # Lines 9 to 12.
            visited.append(SearchPoint(point, result, None, projected))
        else:
            sat = saturation(before, result, rules.top)  # Lines 13 to 16.
            visited.append(SearchPoint(point, result, sat, projected))
            if sat < ALPHA:  # Lines 18 and 19.
                return
            candidates.append(visited[-1])
        before = result
