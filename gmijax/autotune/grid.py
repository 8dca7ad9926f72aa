"""Points of a search, what was measured there, and the ways through their grid. Pure data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

_STRIDE: Final = 3
_COARSE_SIZES: Final = 2


class Point(NamedTuple):
    """A point of the grid."""

    # GMIs on every GPU; where others train, those that act on every GPU that acts.
    gmis_per_gpu: int
    num_envs: int  # Environments per GMI.
    impl: str  # Physics implementation.
    trainers: int = 0  # Training GMIs on every GPU that trains; 0: every GMI does everything.

    @property
    def gmis(self) -> str:
        """`4`, or `4 + 1` with a trainer."""
        return f"{self.gmis_per_gpu}{f' + {self.trainers}' if self.trainers else ''}"

    @property
    def gmis_key(self) -> str:
        """The same in names of files: `4`, or `4+1`."""
        return self.gmis.replace(" ", "")

    def __str__(self) -> str:
        """`4 x 2048, jax`, or `4 + 1 x 2048, jax` with a trainer."""
        return f"{self.gmis} x {self.num_envs}, {self.impl}"


class Measured(NamedTuple):
    """Figures of one GMI at a point.

    Attributes:
      env_steps_per_s: environment steps a second of one GMI, the paper's `top`; where others
        train, those that were learnt from for each GMI that acts.
      memory_mib: its peak memory, MiB, the paper's `mem`.
      iteration_s: seconds of one iteration.
      reduce_s: those of them in the exchange of gradients; 0 where that was not measured.
      acting_per_s: environment steps a second that the agents of one serving GPU could make if
        trainers took everything; 0 where every GMI does everything.
      learning_per_s: those that the trainers of one training GPU could learn from if there were
        always a batch; 0 as above.
    """

    env_steps_per_s: float
    memory_mib: float
    iteration_s: float
    reduce_s: float = 0.0
    acting_per_s: float = 0.0
    learning_per_s: float = 0.0


class NotRunnable(NamedTuple):
    """A point that cannot run."""

    reason: str  # Why, in one line.
    # The time within which it did not end; None where something else was the matter.
    limit_s: float | None = None


class Grid(NamedTuple):
    """All points that may be looked at."""

    gmis_per_gpu: tuple[int, ...]
    num_envs: tuple[int, ...]
    impls: tuple[str, ...]
    trainers: int = 0  # Of every point; they are not searched for.


def coarse(grid: Grid) -> Grid:
    """Every third row, with the largest size and the third below it.

    The row with the fewest GMIs comes first: it starts soonest, and all others are measured by it.
    """
    sizes = sorted(grid.num_envs, reverse=True)[::_STRIDE]
    rows = sorted(grid.gmis_per_gpu, reverse=True)
    return grid._replace(
        gmis_per_gpu=tuple(sorted({*rows[::_STRIDE], rows[-1]})),
        num_envs=tuple(sorted(sizes[:_COARSE_SIZES])),
    )


def neighbours(point: Point, grid: Grid) -> list[Point]:
    """The points one step away in the grid: in GMIs, then in environments."""
    rows = _beside(point.gmis_per_gpu, sorted(grid.gmis_per_gpu))
    sizes = _beside(point.num_envs, sorted(grid.num_envs))
    return [
        *(point._replace(gmis_per_gpu=row) for row in rows),
        *(point._replace(num_envs=size) for size in sizes),
    ]


def _beside(value: int, values: Sequence[int]) -> list[int]:
    at = values.index(value)
    return [values[i] for i in (at + 1, at - 1) if 0 <= i < len(values)]
