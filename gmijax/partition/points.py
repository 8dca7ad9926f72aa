"""What a search measures, and what it finds there. Pure data."""

from __future__ import annotations

from typing import NamedTuple


class Point(NamedTuple):
    """What is to be measured.

    Attributes:
      gmis_per_gpu: GMIs on every GPU; where others train, those that act on every GPU that acts.
      num_envs: environments per GMI.
      impl: physics implementation.
      trainers: training GMIs on every GPU that trains; 0: every GMI does everything.
    """

    gmis_per_gpu: int
    num_envs: int
    impl: str
    trainers: int = 0

    @property
    def gmis(self) -> str:
        """`4`, or `4 + 1` with a trainer."""
        return (
            f"{self.gmis_per_gpu} + {self.trainers}" if self.trainers else f"{self.gmis_per_gpu}"
        )

    def __str__(self) -> str:
        """`4 x 2048, jax`, or `4 + 1 x 2048, jax` with a trainer."""
        return f"{self.gmis} x {self.num_envs}, {self.impl}"


class Measured(NamedTuple):
    """What one GMI did.

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
    """A point that cannot run.

    Attributes:
      reason: why, in one line.
      limit_s: the time within which it did not end; None where something else was the matter.
    """

    reason: str
    limit_s: float | None = None
