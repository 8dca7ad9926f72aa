"""What the training algorithms see of the exchange between GMIs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeGuard, TypeVar

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import jax

FloatBuffer = npt.NDArray[np.float32]
DeviceMean = Callable[["jax.Array"], "jax.Array"]

T = TypeVar("T")


class Reducer(Protocol):
    """Exchanges one flat buffer among the trainers of a job.

    All methods are collective: every rank calls the same ones in the same order, from one
    thread. Results are bit-identical on all ranks.

    Attributes:
      rank: this trainer's place, 0 to `world_size - 1`.
      world_size: K, number of trainers.
      is_device_resident: whether buffers that are in a device's memory should stay there; then
        this is a `DeviceReducer`.
    """

    rank: int
    world_size: int
    is_device_resident: bool

    def mean(self, buffer: FloatBuffer) -> FloatBuffer:
        """Returns the mean over ranks of `buffer` [P] float32.

        It is the sum, in an order of the strategy's, times 1 / K, all in float32. (Not divided
        by K: XLA makes such a product of a division by a constant.) The result may be a
        read-only view that is valid until the next call on this rank.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
        """
        ...

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """Returns [K, M]: `values` [M] float32 of every rank, in order of rank.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
        """
        ...

    def close(self) -> None:
        """Releases what the reducer holds; calling it twice is fine."""
        ...


class Peers(Protocol):
    """The trainers of a job from within a program that the devices of all of them run."""

    def rank(self) -> jax.Array:
        """[] int32: the trainer on whose device this is computed."""
        ...

    def gather(self, values: jax.Array) -> jax.Array:
        """[K, ...]: `values` of every trainer, in order of rank."""
        ...

    def mean(self, buffer: jax.Array) -> jax.Array:
        """The mean over trainers of `buffer` float32, bit-identical on all."""
        ...


Step: TypeAlias = Callable[[Peers, Any, Any, Any], tuple[Any, Any, Any]]
"""`(peers, constants, shared, own) -> (shared, own, metrics)`, trees of arrays.

`shared` and `metrics` are equal on all trainers if they were before; `constants` and `own` are a
trainer's own.
"""


class TracedStep(Protocol):
    """A `Step` of all trainers as one program; every one of them makes the same calls."""

    @property
    def exchange_s(self) -> float | None:
        """Seconds that this trainer's device spent on exchanges, and in waiting for others there.

        Those in the call before the last one; None where they cannot be told apart, and at first.
        """
        ...

    def trace(self, constants: Any, shared: Any, own: Any) -> None:
        """Traces it for these arguments, whose constants are kept."""
        ...

    def compile(self) -> None:
        """Compiles what was traced, or takes it from the cache."""
        ...

    def __call__(self, shared: Any, own: Any) -> tuple[Any, Any, Any]:
        """`(shared, own, metrics)`, the first two on this trainer's device, the last on the host.

        The arguments are donated. All of it may still be computed, but for the metrics of the
        call before; these are there, however long that took while the other trainers were at it
        too.

        Raises:
          PeerLost: the process of another trainer is gone.
          CollectiveTimeout: another trainer did not begin in time, or has not been heard of.
        """
        ...

    def wait(self) -> None:
        """Returns when the last call is computed; raises what `__call__` raises.

        Before its results are read: who reads them would wait for ever for a trainer that died.
        """
        ...


class DeviceReducer(Reducer, Protocol):
    """A `Reducer` whose mean need not pass through host memory.

    Attributes:
      exchange_s: seconds that the exchanges of the last `run_on_device` took, each from the time
        its buffer was there; None where they are queued with all else and cannot be told apart.
    """

    exchange_s: float | None

    def run_on_device(self, program: Callable[[DeviceMean], T]) -> T:
        """Returns what `program(mean)` returns, when all its arrays are computed.

        In it `mean(buffer)` is the mean over ranks of `buffer` [P] float32, an array on this
        rank's device that need not be there yet: what follows is queued behind it, and the
        device does not wait for the host between one exchange and the next. Every rank runs a
        program with as many means.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
        """
        ...

    def mean_on_device(self, buffer: jax.Array) -> jax.Array:
        """Returns the mean over ranks of `buffer` [P] float32, both on this rank's device.

        Both may still be computed, the buffer when this is called and the result when it
        returns; the result is the caller's own.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
        """
        ...

    def spmd(self, step: Step) -> TracedStep | None:
        """`step` as one program that all ranks run together, None where there can be none."""
        ...


def stays_on_device(reducer: Reducer) -> TypeGuard[DeviceReducer]:
    """Whether means can be taken on the device, and should be."""
    return reducer.is_device_resident
