"""Checks of the buffers that are exchanged, and how one is cut into chunks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gmijax.collectives.interface import FloatBuffer
from gmijax.collectives.memory import FLOATS_PER_LINE, MAX_GATHER_FLOATS
from gmijax.errors import CollectiveError

if TYPE_CHECKING:
    import jax


def chunk_bounds(num_floats: int, world_size: int, rank: int) -> tuple[int, int]:
    """First index and end of the part of a buffer [P] that `rank` reduces.

    The chunks of all ranks are disjoint, in order, and cover the buffer. They begin at whole
    cache lines, so that no two ranks write to one line; trailing chunks may be empty.
    """
    num_lines = -(-num_floats // FLOATS_PER_LINE)
    low, high = (num_lines * place // world_size for place in (rank, rank + 1))
    return min(low * FLOATS_PER_LINE, num_floats), min(high * FLOATS_PER_LINE, num_floats)


def require_mean_input(buffer: FloatBuffer, num_floats: int) -> None:
    """Raises CollectiveError unless `buffer` is [P] float32."""
    _require_flat("mean", buffer)
    if buffer.size != num_floats:
        raise CollectiveError(f"mean: got {buffer.size} floats, expected {num_floats}")


def require_device_buffer(buffer: jax.Array, num_floats: int) -> None:
    """Raises CollectiveError unless `buffer` is [P] float32."""
    if buffer.dtype != np.float32 or buffer.shape != (num_floats,):
        raise CollectiveError(
            f"mean: got {buffer.dtype} of shape {list(buffer.shape)}, expected float32 of "
            f"shape [{num_floats}]"
        )


def require_gather_input(values: FloatBuffer) -> None:
    """Raises CollectiveError unless `values` is [M] float32 with M <= MAX_GATHER_FLOATS."""
    _require_flat("all_gather", values)
    if values.size > MAX_GATHER_FLOATS:
        raise CollectiveError(
            f"all_gather: got {values.size} floats, at most {MAX_GATHER_FLOATS} a rank"
        )


def _require_flat(operation: str, buffer: FloatBuffer) -> None:
    if buffer.dtype != np.float32 or buffer.ndim != 1:
        raise CollectiveError(
            f"{operation}: got {buffer.dtype} of shape {list(buffer.shape)}, expected float32 "
            "with one axis"
        )
