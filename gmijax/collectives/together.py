"""Programs that all ranks run together: they meet first, and look at each other meanwhile."""

from __future__ import annotations

import atexit
import functools
from collections.abc import Callable
from typing import Any, TypeVar

from gmijax.collectives.courier import Courier, end_at_once
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import TracedStep
from gmijax.collectives.turns import Turns

T = TypeVar("T")


class Together:
    """One rank's part in programs of all ranks.

    Args:
      host: this rank's use of the shared block.
      courier: of this rank.
      num_floats: P, length of the buffers that ranks exchange.
    """

    def __init__(self, host: HostExchange, courier: Courier, num_floats: int) -> None:
        self._host = host
        self._courier = courier
        self._num_floats = num_floats
        self._is_running = False

    @property
    def is_caught(self) -> bool:
        """Whether the device may be at something that a peer has not come to."""
        return self._courier.is_stuck or self._is_running

    def mean(self, program: Callable[[], T]) -> T:
        """Runs a program that ends when its means are computed; raises as `run_watched`."""
        turns = self._begin("mean")
        result = run_watched(self._courier, turns, program)
        turns.arrive()
        turns.end()
        return result

    def step(self, program: Callable[[], T]) -> T:
        """Runs a program that queues a step of all; raises as `run_watched`.

        From the first one until `settle` the device may be at it, and wait for a peer that is
        gone: what ends this process meanwhile, wherever it is found, ends it at once.
        """
        if not self._is_running:
            self._is_running = True
            atexit.register(end_at_once)
        turns = self._begin("step")
        result = run_watched(self._courier, turns, program, is_step=True)
        turns.meet(is_patient=True)  # Some have given it to their devices a step before others.
        turns.end()
        return result

    def settle(self, program: Callable[[], T]) -> T:
        """Runs a program that returns when all steps are computed; raises as `run_watched`."""
        result = self.step(program)
        self._is_running = False
        atexit.unregister(end_at_once)
        return result

    def close(self) -> None:
        """Ends the courier's thread; calling it twice is fine."""
        self._courier.close()

    def _begin(self, operation: str) -> Turns:
        _, turns = self._host.begin(operation, self._num_floats)
        turns.meet()
        turns.check_same_call()
        return turns


class WatchedStep:
    """A step that is only called when all ranks have come, while peers are looked at."""

    def __init__(self, step: TracedStep, together: Together) -> None:
        self._step = step
        self._together = together

    @property
    def exchange_s(self) -> float | None:
        """See `TracedStep`."""
        return self._step.exchange_s

    def trace(self, constants: Any, shared: Any, own: Any) -> None:
        """See `TracedStep`."""
        self._step.trace(constants, shared, own)

    def compile(self) -> None:
        """See `TracedStep`."""
        self._step.compile()

    def __call__(self, shared: Any, own: Any) -> tuple[Any, Any, Any]:
        """See `TracedStep`."""
        return self._together.step(lambda: self._step(shared, own))

    def wait(self) -> None:
        """See `TracedStep`."""
        self._together.settle(self._step.wait)


def run_watched(
    courier: Courier, turns: Turns, program: Callable[[], T], *, is_step: bool = False
) -> T:
    """Runs a program over several GMIs in the courier's thread.

    Args:
      courier: of this rank.
      turns: in a call that has begun.
      program: that of all ranks.
      is_step: there is more in it than exchanges. It may take any time while all ranks are at
        it, and its own errors stay what they are.

    Raises:
      PeerLost, CollectiveTimeout: see `Turns.watch`.
      CollectiveError: the transfer failed although all peers are there.
    """
    watch = functools.partial(turns.watch, is_step=is_step)
    with turns.explained(is_step=is_step):
        return courier.run(program, watch)
