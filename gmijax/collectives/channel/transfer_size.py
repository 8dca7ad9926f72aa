"""How large a transfer should be: what the user said, or found by trying."""

from __future__ import annotations

import statistics

START_BYTES = 64 * 1024
SAMPLES = 9
WORTH_IT = 0.95
"""A size is better if it takes less than this part of the time per byte."""


class TransferSize:
    """Doubles the size as long as a byte gets cheaper, then keeps the best.

    The price of a transfer is fixed plus so much a byte, so that there is no use in going on
    once it has stopped falling; larger transfers only make experience older.

    Args:
      fixed_bytes: a size to keep to; None: found by trying.
      max_bytes: largest size to try.

    Attributes:
      num_bytes: the size to use now.
      is_settled: whether it will not change any more.
    """

    def __init__(self, fixed_bytes: int | None, max_bytes: int) -> None:
        self.num_bytes = min(fixed_bytes or START_BYTES, max_bytes)
        self.is_settled = fixed_bytes is not None
        self._max_bytes = max_bytes
        self._samples: list[float] = []
        self._best: tuple[float, int] | None = None

    def record(self, num_bytes: int, seconds: float) -> None:
        """Takes note of what one transfer cost, without the time it waited for room."""
        if self.is_settled or not num_bytes:
            return
        self._samples.append(seconds / num_bytes)
        if len(self._samples) < SAMPLES:
            return
        price, self._samples = statistics.median(self._samples), []
        if self._best is None or price < WORTH_IT * self._best[0]:
            self._best = price, self.num_bytes
            # A transfer that holds one piece already, however large, cannot show more.
            larger = 2 * max(self.num_bytes, num_bytes)
            if larger <= self._max_bytes:
                self.num_bytes = larger
                return
        self.num_bytes, self.is_settled = self._best[1], True
