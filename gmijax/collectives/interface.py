"""What the training algorithms see of the exchange between GMIs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeGuard

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import jax

FloatBuffer = npt.NDArray[np.float32]


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

        The result may be a read-only view that is valid until the next call on this rank.

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


class DeviceReducer(Reducer, Protocol):
    """A `Reducer` whose mean need not pass through host memory."""

    def mean_on_device(self, buffer: jax.Array) -> jax.Array:
        """Returns the mean over ranks of `buffer` [P] float32, both on this rank's device.

        The buffer may still be computed when this is called; the result is there on return,
        and is the caller's own.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
        """
        ...


def stays_on_device(reducer: Reducer) -> TypeGuard[DeviceReducer]:
    """Whether `mean_on_device` is there, and better than `mean`."""
    return reducer.is_device_resident
