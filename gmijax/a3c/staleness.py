"""How old experience is: versions of the policy between acting and learning."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

MAX_COUNTED = 127
"""Anything older counts as this old in the figures."""


class BatchCounts(NamedTuple):
    """The batches of all trainers for one update.

    Attributes:
      stop: how many trainers have been asked to stop.
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


def histogram_of(versions_behind: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
    """[MAX_COUNTED + 1]: how many are so many versions behind."""
    clipped = np.clip(versions_behind, 0, MAX_COUNTED)
    return np.bincount(clipped, minlength=MAX_COUNTED + 1).astype(np.float32)


def mean_and_p99(histogram: npt.NDArray[np.floating]) -> tuple[float, float] | None:
    """Mean and 99th percentile of versions behind; None while there are none.

    The percentile is the smallest number that at least 99 % do not exceed.
    """
    total = float(histogram.sum())
    if not total:
        return None
    behind = np.arange(len(histogram))
    p99 = int(np.searchsorted(np.cumsum(histogram), 0.99 * total - 1e-6))
    return float(histogram @ behind) / total, float(behind[min(p99, len(behind) - 1)])
