"""How old experience is: versions of the policy between acting and learning."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

MAX_COUNTED = 127
"""Anything older counts as this old in the figures."""


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
