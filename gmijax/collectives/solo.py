"""The reducer of a job with one GMI: nothing to exchange."""

from __future__ import annotations

from gmijax.collectives.buffers import require_gather_input, require_mean_input
from gmijax.collectives.interface import FloatBuffer


class SoloReducer:
    """A `Reducer` for one rank, with the same checks as the others.

    Args:
      num_floats: P, length of the buffers for `mean`.
    """

    is_device_resident = False

    def __init__(self, num_floats: int) -> None:
        self.rank = 0
        self.world_size = 1
        self._num_floats = num_floats

    def mean(self, buffer: FloatBuffer) -> FloatBuffer:
        """Returns a read-only view of `buffer` [P] float32.

        Raises:
          CollectiveError: the buffer has another length or type.
        """
        require_mean_input(buffer, self._num_floats)
        result = buffer.view()
        result.flags.writeable = False
        return result

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """Returns [1, M], a copy of `values` [M] float32.

        Raises:
          CollectiveError: too many values, or another type.
        """
        require_gather_input(values)
        return values[None].copy()

    def close(self) -> None:
        """Does nothing: there is nothing to release."""
