"""What the training algorithms see of the exchange between GMIs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import jax

FloatBuffer = npt.NDArray[np.float32]

T = TypeVar("T")


class Collectives(Protocol):
    """The trainers of a job, from within a program that all of them run.

    XLA may start exchanges that do not depend on each other in any order, and trainers that start
    them in different orders fail: pass as `after` what has to be computed before.
    """

    def rank(self) -> jax.Array:
        """[] int32: the trainer on whose device this is computed."""
        ...

    def all_gather(self, tree: T, after: Any = None) -> T:
        """`tree` of every trainer, float32; leaves [...] become [K, ...], in order of rank.

        For at most P / K numbers, or 1024.

        Args:
          tree: of this trainer.
          after: what has to be computed before.
        """
        ...

    def mean(self, tree: T, after: Any = None) -> T:
        """The mean over trainers of `tree`, float32, with at most P numbers; the same bits on all.

        It is the sum, in an order of the strategy's, times 1 / K, all in float32. (Not divided
        by K: XLA makes such a product of a division by a constant.)

        Args:
          tree: of this trainer.
          after: what has to be computed before.
        """
        ...


Step: TypeAlias = Callable[[Collectives, Any, Any, Any], tuple[Any, Any, Any]]
"""`(collectives, constants, shared, own) -> (shared, own, metrics)`, trees of arrays.

`shared` and `metrics` are equal on all trainers if they were before; `constants` and `own` are a
trainer's own.
"""


class TracedStep(Protocol):
    """A `Step` of all trainers, each with its own program; all of them make the same calls."""

    @property
    def exchange_s(self) -> float | None:
        """Seconds that this trainer spent on exchanges, and in waiting for others there.

        Those in the call before the last one; None where there are none, and at first.
        """
        ...

    def trace(self, constants: Any, shared: Any, own: Any) -> None:
        """Traces it for these arguments; the constants are kept."""
        ...

    def compile(self) -> None:
        """Compiles what was traced, or takes it from the cache."""
        ...

    def __call__(self, shared: Any, own: Any) -> tuple[Any, Any, Any]:
        """`(shared, own, metrics)`, the first two on this trainer's device, the last on the host.

        The arguments are donated, `own` only if it is returned alike (`Communicator.program`). All
        of it may still be computed, but for the metrics of the call before.

        Raises:
          PeerLost: the process of another trainer is gone.
          CollectiveTimeout: another trainer did not arrive in time, or sent no heartbeat.
          CollectiveError: trainers make different exchanges.
        """
        ...

    def wait(self) -> None:
        """Returns when the last call is computed; raises what `__call__` raises.

        Call it before reading the results: a read would wait forever for a trainer that died.
        """
        ...


class Communicator(Protocol):
    """Exchanges numbers among the trainers of a job.

    Attributes:
      rank: this trainer's number, 0 to `world_size - 1`.
      world_size: K, number of trainers.
      strategy: the one in use, also where the requested one was not available.
      intra: how the GMIs of one GPU exchange numbers in `har`, `host` or `ipc`.
      inter: how nodes exchange numbers, `nccl` or `tcp`; None where there is one.
    """

    rank: int
    world_size: int
    strategy: str
    intra: str
    inter: str | None

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """Returns [K, M]: `values` [M] float32 of every rank, in order of rank.

        Collective: every rank makes the same calls in the same order.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
        """
        ...

    def program(self, step: Step, *, donates_own: bool = True) -> TracedStep:
        """`step` as a program in which the trainers exchange numbers.

        Args:
          step: see `Step`.
          donates_own: whether what the step returns as `own` takes the memory of the argument.
        """
        ...

    def close(self) -> None:
        """Releases what the communicator holds. Idempotent."""
        ...
