"""Where experience lies on the GPU: slots of an agent's block, and the notes that tell of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gmijax.collectives.channel.spec import Spec

_ALIGNMENT = 256

NOTE = np.dtype([("offset", np.int64), ("num_envs", np.int64), ("version", np.int64)])
"""What travels: where a rollout lies, of how many environments it is, and of which policy."""


class Slot(NamedTuple):
    """Where the arrays of a rollout lie.

    Attributes:
      offsets: bytes from the beginning of the slot, in the order of the spec.
      num_bytes: of the slot.
    """

    offsets: tuple[int, ...]
    num_bytes: int


def slot_of(spec: Spec, num_envs: int) -> Slot:
    """Where the arrays of a rollout of `num_envs` environments lie."""
    offsets, end = [], 0
    for size in spec.sizes(num_envs):
        offsets.append(end)
        end += -(-size // _ALIGNMENT) * _ALIGNMENT
    return Slot(tuple(offsets), end)
