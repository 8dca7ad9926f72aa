"""How ranks wait for each other: counters in shared memory, no sockets, no locks.

Every rank owns a counter that only goes up. To arrive is to raise one's own counter by one; to
wait is to read the others' until all have reached one's own. A call is one or two arrivals, and
all ranks make the same calls in the same order, so equal counters mean the same place.
"""

from __future__ import annotations

import os
import threading
import time

from gmijax.collectives.memory import ExchangeBlock, check_peer, process_of
from gmijax.errors import CollectiveError, CollectiveTimeout, PeerLost

OPERATIONS = ("mean", "all_gather")
"""What a rank can be calling; the wire format holds the position in this tuple."""

COUNT_SHIFT = 8  # bits of a call word below the number of floats

SPIN_S = 200e-6
"""How long a waiting rank only gives way before it sleeps.

GMIs that do equal work arrive within microseconds of each other if every one has a core.
"""

MIN_SLEEP_S, MAX_SLEEP_S = 10e-6, 100e-6
LIVENESS_PERIOD_S = 0.2


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
        self._block = block
        self._timeout_s = timeout_s
        self._rendezvous_timeout_s = rendezvous_timeout_s
        self._peers = [p for p in range(len(block.lines)) if p != block.rank]
        self._sequence = block.lines["sequence"]
        self._operation = ""
        self._unfinished = False
        self._thread: int | None = None
        self._fence_lock = threading.Lock()
        self._fence_lock.acquire()
        self._arrive()

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
            self._wait()  # counters of 1: all have attached
            for peer in self._peers:
                check_peer(self._block, peer)
        word = OPERATIONS.index(operation) | count << COUNT_SHIFT
        self._block.lines["call"][rank, self.step % 2] = word

    def meet(self) -> None:
        """Arrives, and waits until all ranks have arrived here.

        What a rank wrote before is visible to all after it, and what it read before is read.

        Raises:
          PeerLost: the process of a rank that has not arrived is gone.
          CollectiveTimeout: ranks did not arrive in time.
        """
        self._arrive()
        self._wait()

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

    def _arrive(self) -> None:
        self._fence()
        self._sequence[self._block.rank] += 1

    def _wait(self) -> None:
        target = int(self._sequence[self._block.rank])
        timeout_s = self._rendezvous_timeout_s if self.step == 1 else self._timeout_s
        start = time.monotonic()
        next_check, pause_s = start + LIVENESS_PERIOD_S, MIN_SLEEP_S
        missing = self._missing(self._peers, target)
        while missing:
            waited_s = time.monotonic() - start
            if waited_s < SPIN_S:
                os.sched_yield()
            else:
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, MAX_SLEEP_S)
            missing = self._missing(missing, target)
            late = waited_s >= timeout_s
            if missing and (late or start + waited_s >= next_check):
                next_check += LIVENESS_PERIOD_S
                self._check_alive(missing, target)
                if late:
                    raise CollectiveTimeout(
                        self._block.rank, tuple(missing), self._operation, self.step, timeout_s
                    )
        self._fence()

    def _missing(self, peers: list[int], target: int) -> list[int]:
        counter_of = self._sequence.item
        return [peer for peer in peers if counter_of(peer) < target]

    def _check_alive(self, missing: list[int], target: int) -> None:
        for peer in missing:
            # A rank that has not attached cannot be told from one that is still starting.
            if not self._sequence[peer] or process_of(self._block, peer).is_running():
                continue
            # It may have arrived and ended, in this order, since it was found missing.
            if self._missing([peer], target):
                raise PeerLost(self._block.rank, peer, self._operation, self.step)

    def _fence(self) -> None:
        """Keeps the processor from moving memory accesses across this point.

        A release followed by an acquire of one lock does that on all processors of interest;
        the lock is private and never contended, so that this costs 0.1 us.
        """
        self._fence_lock.release()
        self._fence_lock.acquire()


def _describe(word: int) -> str:
    operation = OPERATIONS[word & (1 << COUNT_SHIFT) - 1]
    return f"{operation} of {word >> COUNT_SHIFT} floats"
