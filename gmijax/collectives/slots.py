"""Sums over the slots of the shared block."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.memory import ExchangeBlock

BLOCK_FLOATS = 32768
"""Floats summed at a time: 128 KiB of sums stay in the second-level cache over all ranks."""


def add_slots(
    block: ExchangeBlock,
    ranks: Sequence[int],
    part: slice,
    total: FloatBuffer,
    scale: float = 1.0,
) -> None:
    """Writes the sum of the slots of `ranks`, in this order, times `scale`; only within `part`.

    Args:
      block: the shared block.
      ranks: whose slots.
      part: from where to where.
      total: [length of `part`], for the sum; may be this part of the first rank's own slot.
      scale: what to multiply the sum with.
    """
    for start in range(part.start, part.stop, BLOCK_FLOATS):
        end = min(start + BLOCK_FLOATS, part.stop)
        piece = total[start - part.start : end - part.start]
        piece[:] = block.slots[ranks[0], start:end]
        for rank in ranks[1:]:
            piece += block.slots[rank, start:end]
        if scale != 1.0:
            piece *= np.float32(scale)


def read_only(array: FloatBuffer) -> FloatBuffer:
    """A view of `array` that cannot be written."""
    view = array.view()
    view.flags.writeable = False
    return view
