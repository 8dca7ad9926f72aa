"""What the training algorithms see of the exchange between GMIs."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatBuffer = npt.NDArray[np.float32]


class Reducer(Protocol):
    """Exchanges one flat buffer among the trainers of a job.

    All methods are collective: every rank calls the same ones in the same order, from one
    thread. Results are bit-identical on all ranks.

    Attributes:
      rank: this trainer's place, 0 to `world_size - 1`.
      world_size: K, number of trainers.
    """

    rank: int
    world_size: int

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
