"""Runs what is measured at the same time where GPUs are free, each on its own."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from types import MappingProxyType
from typing import NamedTuple, TypeVar

from gmijax.machine.snapshot import Machine

Turn = TypeVar("Turn")
Made = TypeVar("Made")


class FreeGpus:
    """The GPUs that are free, by index; usable from any thread.

    Who asked first gets first: who needs several is not passed by others that need one.
    """

    def __init__(self, count: int) -> None:
        self._free = set(range(count))
        self._waiting: deque[object] = deque()
        self._changed = threading.Condition()

    @contextmanager
    def taken(self, count: int = 1) -> Iterator[tuple[int, ...]]:
        """Takes `count` of them once so many are free."""
        me = object()
        with self._changed:
            self._waiting.append(me)
            self._changed.wait_for(lambda: self._waiting[0] is me and len(self._free) >= count)
            self._waiting.popleft()
            mine = sorted(self._free)[:count]
            self._free.difference_update(mine)
            self._changed.notify_all()
        try:
            yield tuple(mine)
        finally:
            with self._changed:
                self._free.update(mine)
                self._changed.notify_all()


def on_free_gpus(
    count: int | None,
    turns: Sequence[Turn],
    num_gpus: Callable[[Turn], int],
    run: Callable[[Turn, tuple[int, ...]], Made],
) -> list[Made]:
    """Runs all of `turns`, each as soon as so many GPUs are free for it.

    Args:
      count: of GPUs; None: one after the other in this thread, which signals interrupt, and no
        GPU is given to any.
      turns: what is run.
      num_gpus: how many GPUs one of them needs.
      run: runs one on GPUs with these indices.
    """
    if count is None:
        return [run(turn, ()) for turn in turns]
    free = FreeGpus(count)

    def alone(turn: Turn) -> Made:
        with free.taken(num_gpus(turn)) as gpus:
            return run(turn, gpus)

    with ThreadPoolExecutor(count) as pool:
        started = [pool.submit(alone, turn) for turn in turns]
        try:
            return [one.result() for one in started]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


class Part(NamedTuple):
    """A GPU with its part of the cores, for a command that is to see no other.

    Attributes:
      prefix: words before the command.
      variables: of its environment.
    """

    prefix: tuple[str, ...] = ()
    variables: Mapping[str, str] = MappingProxyType({})


def part_of(machine: Machine, gpu: int, count: int) -> Part:
    """The GPU with index `gpu`, where `count` of them are used at the same time."""
    each = len(machine.cpu_cores) // count
    cores = machine.cpu_cores[gpu * each : (gpu + 1) * each]
    device = str(machine.gpus[gpu].index)
    return Part(
        ("taskset", "--cpu-list", ",".join(map(str, cores))),
        {"CUDA_VISIBLE_DEVICES": device, "CUDA_DEVICE_ORDER": "PCI_BUS_ID"},
    )


def on_parts(
    machine: Machine, count: int, turns: Sequence[Turn], run: Callable[[Turn, Part], Made]
) -> list[Made]:
    """Runs all of `turns`, each on a part of the machine if at least two GPUs are used.

    Args:
      machine: where they run.
      count: GPUs to use, if there are as many.
      turns: what is run.
      run: runs one on a part; on all of the machine where that is not divided.
    """
    used = min(count, len(machine.gpus))

    def alone(turn: Turn, gpus: tuple[int, ...]) -> Made:
        return run(turn, part_of(machine, gpus[0], used) if gpus else Part())

    return on_free_gpus(used if used > 1 else None, turns, lambda _: 1, alone)
