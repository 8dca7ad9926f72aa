"""Which GPUs have room for another run."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

_MEMORY_FRACTION = 0.9
"""Of a GPU, for all runs on it."""


class FreeGpus:
    """The GPUs that have room for a case, by index; usable from any thread.

    Attributes:
      count: how many there are.
      together: how many cases of one GPU may share it.
    """

    def __init__(self, count: int, together: int = 1) -> None:
        self.count = count
        self.together = together
        self._room = [together] * count
        self._changed = threading.Condition()

    def overrides(self, taken: list[int]) -> Iterator[str]:
        """The part of a plan that keeps a run to its share."""
        yield f"plan.gpus=[{','.join(map(str, taken))}]"
        if self.together > 1:
            yield "plan.backend=mps"
            yield f"plan.memory_fraction={_MEMORY_FRACTION / self.together:.3f}"

    @contextmanager
    def taken(self, count: int) -> Iterator[list[int]]:
        """The `count` emptiest of them, once so many have room."""
        with self._changed:
            self._changed.wait_for(lambda: sum(map(bool, self._room)) >= count)
            by_room = sorted(range(self.count), key=lambda gpu: -self._room[gpu])
            mine = sorted(by_room[:count])
            self._change(mine, -1)
        try:
            yield mine
        finally:
            with self._changed:
                self._change(mine, 1)
                self._changed.notify_all()

    def _change(self, gpus: list[int], by: int) -> None:
        for gpu in gpus:
            self._room[gpu] += by
