"""What trainers count of a batch, together."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt


class Tally(NamedTuple):
    """What trainers tell each other with every batch.

    Attributes:
      stop: how many have been asked to stop.
      fresh: unrolls that are learnt from.
      stale: unrolls that were too old, those of batches that were passed over too.
      receive_s: seconds that the last of them waited for experience.
      staleness: [MAX_COUNTED + 1] unrolls by versions behind.
    """

    stop: float
    fresh: float
    stale: float
    receive_s: float
    staleness: npt.NDArray[np.float32]
