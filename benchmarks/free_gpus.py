"""Which GPUs are free for another run."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class FreeGpus:
    """The GPUs that are free, by index; usable from any thread.

    Attributes:
      count: how many there are.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._free = set(range(count))
        self._changed = threading.Condition()

    @contextmanager
    def taken(self, count: int) -> Iterator[tuple[str, ...]]:
        """Takes `count` of them once so many are free; the overrides that keep a run to them."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._free) >= count)
            mine = sorted(self._free)[:count]
            self._free.difference_update(mine)
        try:
            yield (f"plan.gpus=[{','.join(map(str, mine))}]",)
        finally:
            with self._changed:
                self._free.update(mine)
                self._changed.notify_all()
