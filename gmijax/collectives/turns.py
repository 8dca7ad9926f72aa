"""How ranks wait for each other: counters in shared memory, no sockets, no locks.

Every rank owns a counter that only goes up. To arrive is to raise one's own counter by one; to
wait is to read the others' until all have reached one's own. A call is one or two arrivals, and
all ranks make the same calls in the same order, so equal counters mean the same place.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from gmijax.collectives.memory import ExchangeBlock, check_peer
from gmijax.collectives.suspects import Suspects
from gmijax.collectives.waits import LIVENESS_PERIOD_S, MAX_SLEEP_S, MIN_SLEEP_S, SPIN_S, Fence
from gmijax.errors import CollectiveError, CudaError

OPERATIONS = ("mean", "all_gather", "step")
"""What a rank can be calling; the wire format holds the position in this tuple."""

COUNT_SHIFT = 8  # bits of a call word below the number of floats

SETTLE_S = 2.0
"""How long to look for a dead peer after a transfer failed: the error comes before the death."""


class Turns:
    """One rank's side of the waiting.

    Args:
      block: the shared block.
      timeout_s: longest wait for the other ranks.
      rendezvous_timeout_s: the same in the first call, when others may still start or compile.
    """

    def __init__(
        self, block: ExchangeBlock, timeout_s: float, rendezvous_timeout_s: float
    ) -> None:
        self.step = 0
        self._first_step = 1
        self._block = block
        self._timeout_s = timeout_s
        self._rendezvous_timeout_s = rendezvous_timeout_s
        self._peers = [p for p in range(len(block.lines)) if p != block.rank]
        self._sequence = block.lines["sequence"]
        self._operation = ""
        self._unfinished = False
        self._thread: int | None = None
        self._fence = Fence()
        self.arrive()

    def rendezvous(self) -> None:
        """Waits until all ranks have attached; the first call does so too.

        Raises:
          CollectiveError: ranks attached with different numbers.
          PeerLost, CollectiveTimeout: as in `meet`.
        """
        self._operation = "start"
        self._wait_for_all()

    def restart(self) -> None:
        """Says that the calls so far belong to the start: the next one is the first."""
        self._first_step = self.step + 1

    def begin(self, operation: str, count: int) -> None:
        """Opens a call of `operation` with `count` floats.

        Raises:
          CollectiveError: an earlier call failed, this is another thread than before, or (first
            call only) ranks attached with different numbers.
          PeerLost, CollectiveTimeout: (first call only) as in `meet`.
        """
        rank = self._block.rank
        thread = threading.get_ident()
        if self._unfinished:
            raise CollectiveError(f"rank {rank}: {operation} after a call that did not finish")
        if self._thread not in (None, thread):
            raise CollectiveError(f"rank {rank}: {operation} called from a second thread")
        self._thread, self._operation, self._unfinished = thread, operation, True
        self.step += 1
        if self.step == 1:
            self._wait_for_all()
        word = OPERATIONS.index(operation) | count << COUNT_SHIFT
        self._block.lines["call"][rank, self.step % 2] = word

    def meet(self, *, is_patient: bool = False) -> None:
        """Arrives, and waits until all ranks have arrived here.

        What a rank wrote before is visible to all after it, and what it read before is read.

        Args:
          is_patient: time only counts while one of those who have not arrived is silent.

        Raises:
          PeerLost: the process of a rank that has not arrived is gone.
          CollectiveTimeout: ranks did not arrive in time.
        """
        self.arrive()
        self._wait(is_patient=is_patient)

    def watch(self, done: threading.Event, *, is_step: bool = False) -> None:
        """Waits for a thread of this rank that exchanges numbers with peers in its own way.

        Returns when `done` is set. Until then peers are looked at that have not arrived where
        this rank arrives next.

        Args:
          done: when this is set.
          is_step: all meet after it, and the devices of those who have arrived there may still
            be at it: so all peers are looked at, and time only counts while one of them is
            silent. If they are all caught in it, the controller will see that nothing goes on.

        Raises:
          PeerLost: the process of such a peer is gone.
          CollectiveTimeout: the thread did not finish in time.
        """
        suspects, concerned = self._suspects(), self._concerned(is_step=is_step)
        while not done.wait(LIVENESS_PERIOD_S):
            suspects.look(concerned, now=True, is_patient=is_step)
            if suspects.is_late:  # All have come out of it but this rank.
                suspects.give_up(self._peers)

    def explain_failure(self, *, is_step: bool = False) -> None:
        """Raises for the peer whose end made a transfer of this rank fail, if there is one.

        Args:
          is_step: see `watch`.

        Raises:
          PeerLost, CollectiveTimeout: as in `watch`.
        """
        suspects, concerned = self._suspects(), self._concerned(is_step=is_step)
        deadline_s = time.monotonic() + SETTLE_S
        while time.monotonic() < deadline_s:
            suspects.look(concerned, now=True)
            time.sleep(0.02)
        if silent := suspects.silent(concerned()):
            suspects.give_up(silent)

    @contextmanager
    def explained(self, *, is_step: bool = False) -> Iterator[None]:
        """Says of a transfer that fails whose end made it fail.

        Args:
          is_step: see `watch`; and an error that no peer explains stays what it is.

        Raises:
          PeerLost, CollectiveTimeout: see `explain_failure`.
          CollectiveError: the transfer failed although all peers are there.
        """
        try:
            yield
        # A transfer that fails while jax still dispatches it comes as a plain ValueError. Other
        # errors of jax are RuntimeErrors, and those of shared device memory CudaErrors.
        except (RuntimeError, ValueError, CudaError) as error:
            self.explain_failure(is_step=is_step)
            if is_step:
                raise
            said = (str(error).splitlines() or [type(error).__name__])[0]
            raise CollectiveError(f"{self.where()}: {said}") from error

    def where(self) -> str:
        """Rank, operation and step, for messages."""
        return f"rank {self._block.rank}: {self._operation}, step {self.step}"

    def arrive(self) -> None:
        """Says that this rank has got here, without waiting for the others."""
        self._fence()
        self._sequence[self._block.rank] += 1

    def check_same_call(self) -> None:
        """Raises CollectiveError unless all ranks make the same call; only after `meet`."""
        # A peer may be one step ahead, not two: for the second it needs this rank in the first.
        # Two words by parity therefore suffice.
        words = self._block.lines["call"][:, self.step % 2]
        own = words[self._block.rank]
        for peer in self._peers:
            if words[peer] != own:
                raise CollectiveError(
                    f"step {self.step}: rank {self._block.rank} calls {_describe(int(own))}, "
                    f"rank {peer} calls {_describe(int(words[peer]))}"
                )

    def end(self) -> None:
        """Closes the call that `begin` opened."""
        self._unfinished = False

    def leave(self) -> None:
        """Tells the others that this rank will not come again."""
        self._block.lines["pid"][self._block.rank] = 0

    def _wait_for_all(self) -> None:
        self._wait()  # counters of 1: all have attached
        for peer in self._peers:
            check_peer(self._block, peer)

    def _wait(self, *, is_patient: bool = False) -> None:
        target = int(self._sequence[self._block.rank])
        start = time.monotonic()
        suspects, pause_s = self._suspects(), MIN_SLEEP_S
        missing = self._missing(self._peers, target)
        while missing:
            if time.monotonic() - start < SPIN_S:
                os.sched_yield()
            else:
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, MAX_SLEEP_S)
                suspects.look(lambda: self._missing(self._peers, target), is_patient=is_patient)
            missing = self._missing(missing, target)
        self._fence()

    def _suspects(self) -> Suspects:
        is_first = self.step <= self._first_step
        timeout_s = self._rendezvous_timeout_s if is_first else self._timeout_s
        return Suspects(self._block, self._operation, self.step, timeout_s)

    def _concerned(self, *, is_step: bool) -> Callable[[], list[int]]:
        return (lambda: self._peers) if is_step else self._behind

    def _behind(self) -> list[int]:
        """Peers that have not arrived where this rank arrives next."""
        return self._missing(self._peers, int(self._sequence[self._block.rank]) + 1)

    def _missing(self, peers: list[int], target: int) -> list[int]:
        counter_of = self._sequence.item
        return [peer for peer in peers if counter_of(peer) < target]


def _describe(word: int) -> str:
    operation = OPERATIONS[word & (1 << COUNT_SHIFT) - 1]
    return f"{operation} of {word >> COUNT_SHIFT} floats"
