"""GPUs of one user go to one sweep at a time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager

from gmijax.runs.cache import cache_folder
from gmijax.runs.folder import try_lock

_POLL_S = 0.2


@contextmanager
def leased(
    devices: Iterable[str], say: Callable[[str], None], is_over: Callable[[], bool]
) -> Iterator[bool]:
    """Holds all devices; waits for those that another sweep has.

    Args:
      devices: UUIDs of GPUs or MIG instances.
      say: told in a sentence whom it waits for.
      is_over: whether to give up; what is yielded is then false.
    """
    folder = cache_folder() / "leases"
    with ExitStack() as held:
        # In one order, so that two sweeps do not wait for each other.
        for device in sorted(set(devices)):
            folder.mkdir(parents=True, exist_ok=True)
            lock = folder / f"{device}.lock"
            if (fd := try_lock(lock)) is None:
                say(f"another sweep has {device}: waiting until it ends")
            while fd is None:
                if is_over():
                    yield False
                    return
                time.sleep(_POLL_S)
                fd = try_lock(lock)
            held.callback(os.close, fd)
        yield True
