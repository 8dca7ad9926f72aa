"""The grid of a search, and the ways through it (paper, Algorithm 2). No jax."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from gmijax.partition.points import Point

_STRIDE: Final = 3
_COARSE_SIZES: Final = 2


class Grid(NamedTuple):
    """All points that may be looked at."""

    gmis_per_gpu: tuple[int, ...]
    num_envs: tuple[int, ...]
    impls: tuple[str, ...]
    trainers: tuple[int, ...] = (0,)


def as_printed(grid: Grid) -> Grid:
    """The grid in the paper's order: from the most GMIs down, from the smallest size up."""
    rows = tuple(sorted(grid.gmis_per_gpu, reverse=True))
    return grid._replace(gmis_per_gpu=rows, num_envs=tuple(sorted(grid.num_envs)))


def coarse(grid: Grid) -> Grid:
    """Every third row, with the largest size and the third below it.

    The row with the fewest GMIs is among them: it is the measure of all others. It comes first,
    because the fewer GMIs, the sooner they have started, and time may run out. Smaller sizes are
    left to the climb: where there is room for more environments, few are hardly ever the answer.
    """
    sizes = sorted(grid.num_envs, reverse=True)[::_STRIDE]
    return Grid(
        _some_rows(grid.gmis_per_gpu),
        tuple(sorted(sizes[:_COARSE_SIZES])),
        grid.impls,
        _some_rows(grid.trainers),
    )


def first_row(grid: Grid) -> Grid:
    """The row with the fewest GMIs of a grid that begins with it."""
    return grid._replace(gmis_per_gpu=grid.gmis_per_gpu[:1], trainers=grid.trainers[:1])


def neighbours(point: Point, grid: Grid) -> list[Point]:
    """The points one step away in the grid: in GMIs, in trainers, then in environments."""
    rows = _beside(point.gmis_per_gpu, sorted(grid.gmis_per_gpu))
    trainers = _beside(point.trainers, sorted(grid.trainers))
    sizes = _beside(point.num_envs, sorted(grid.num_envs))
    return [
        *(point._replace(gmis_per_gpu=row) for row in rows),
        *(point._replace(trainers=number) for number in trainers),
        *(point._replace(num_envs=size) for size in sizes),
    ]


def _some_rows(values: Sequence[int]) -> tuple[int, ...]:
    rows = sorted(values, reverse=True)
    return tuple(sorted({*rows[::_STRIDE], rows[-1]}))


def _beside(value: int, values: Sequence[int]) -> list[int]:
    at = values.index(value)
    return [values[i] for i in (at + 1, at - 1) if 0 <= i < len(values)]
