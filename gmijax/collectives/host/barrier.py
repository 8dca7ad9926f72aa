"""How ranks wait for each other: counters in shared memory, no sockets, no locks.

Every rank owns a counter that only goes up. A rank arrives by adding one to its counter, and
waits until the counters of all others have come as far. A call is one or two arrivals, and
all ranks make the same calls in the same order, so equal counters mean the same call.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Protocol

from gmijax.clock import running_s
from gmijax.collectives.host.failure_detector import FailureDetector
from gmijax.collectives.host.shared_block import SharedBlock
from gmijax.collectives.shared_memory import Fence
from gmijax.collectives.waits import LIVENESS_PERIOD_S, wait_until
from gmijax.errors import CollectiveError, CudaError

OPERATIONS = ("sum", "gather", "broadcast", "all_gather", "step")
"""What a rank can be calling; the wire format holds the position in this tuple."""

COUNT_SHIFT, CALL_INDEX_SHIFT = 8, 48
"""Bits of a call word: operation, number of floats, which of its program's exchanges it is."""

SETTLE_S = 2.0
"""How long to look for a dead peer after a transfer failed: the error comes before the death."""


class OtherNodes(Protocol):
    """The leaders of other nodes, as the leader of this one sees them: `LeaderWatch`."""

    def beat(self) -> None:
        """Sends them a heartbeat: this node waits. Called five times a second in every wait."""
        ...

    def look(self, since_s: float, timeout_s: float, operation: str, step: int) -> None:
        """Raises PeerLost or CollectiveTimeout for one that this node cannot wait for."""
        ...


class Barrier:
    """One rank's side of the waiting; for the times see `SharedMemoryGroup`.

    Attributes:
      step: number of calls so far.
      other_nodes: of the leader of one of several nodes, else None.
    """

    def __init__(self, block: SharedBlock, timeout_s: float, rendezvous_timeout_s: float) -> None:
        self.step = 0
        self.other_nodes: OtherNodes | None = None
        self._first_step = 1
        self._block = block
        self._timeout_s = timeout_s
        self._rendezvous_timeout_s = rendezvous_timeout_s
        self._peers = [p for p in range(len(block.lines)) if p != block.rank]
        self._sequence = block.lines["sequence"]
        self._operation = ""
        self._is_open = False
        self._fence = Fence()
        self.arrive()

    def restart(self) -> None:
        """Marks the calls so far as part of the start: the next one is the first."""
        self._first_step = self.step + 1

    def begin(self, operation: str, count: int, call_index: int = 0) -> None:
        """Opens a call of `operation` (see `OPERATIONS`) with `count` floats; `end` closes it.

        `call_index` is the number of the exchange in its program.

        Raises:
          CollectiveError: an earlier call failed, or (first call only) ranks attached with
            different numbers.
          PeerLost, CollectiveTimeout: (first call only) as in `wait`.
        """
        rank = self._block.rank
        if self._is_open:
            gmi = self._block.ids[rank]
            raise CollectiveError(f"GMI {gmi}: {operation} after a call that did not finish")
        self._operation, self._is_open = operation, True
        self.step += 1
        if self.step == 1:
            self._wait_for_all()
        word = OPERATIONS.index(operation) | count << COUNT_SHIFT
        word |= (call_index & 0xFFFF) << CALL_INDEX_SHIFT
        self._block.lines["call"][rank, self.step % 2] = word

    def wait(self, *, while_unresponsive: bool = False, looks_at_nodes: bool = False) -> None:
        """Arrives, and waits until all ranks have arrived here.

        What a rank wrote before is visible to all after it, and what it read before is read.

        Args:
          while_unresponsive: time only counts while a rank that has not arrived is unresponsive.
          looks_at_nodes: what a rank has not come out of may be for another node to end, so the
            leader looks at these too.

        Raises:
          PeerLost: the process of a rank that has not arrived is gone, or another node.
          CollectiveTimeout: ranks did not arrive in time.
        """
        self.arrive()
        self._wait(while_unresponsive=while_unresponsive, looks_at_nodes=looks_at_nodes)

    def watch(self, done: threading.Event) -> None:
        """Waits for a step that this rank's device runs together with the others'.

        Returns when `done` is set. Devices of ranks that have come out of the step may still be
        at it, so all peers are looked at, and time only counts while one of them is unresponsive.
        If all are stuck in it, the controller will see that there is no progress.

        Raises:
          PeerLost: the process of a peer is gone.
          CollectiveTimeout: a peer is unresponsive, or all have come out of it but this rank.
        """
        detector, since_s = self._detector(), running_s()
        while not done.wait(LIVENESS_PERIOD_S):
            detector.look(lambda: self._peers, while_unresponsive=True)
            self._look_at_other_nodes(since_s)
            if self._peers and detector.is_late:
                detector.give_up(self._peers)

    @contextmanager
    def raise_peer_failure(self) -> Iterator[None]:
        """Replaces the error of a step by that of a peer that has ended or is unresponsive.

        Raises:
          PeerLost, CollectiveTimeout: see `watch`; an error that no peer explains stays as it is.
        """
        try:
            yield
        # A transfer that fails while jax still dispatches it comes as a plain ValueError. Other
        # errors of jax are RuntimeErrors, and those of shared device memory CudaErrors.
        except (RuntimeError, ValueError, CudaError):
            self._look_for_a_cause()
            raise

    def check_same_call(self) -> None:
        """Raises CollectiveError unless all ranks make the same call; only after `wait`."""
        # A peer may be one step ahead, not two: for the second it needs this rank in the first.
        # Two words by parity therefore suffice.
        words = self._block.lines["call"][:, self.step % 2]
        own, ids = words[self._block.rank], self._block.ids
        for peer in self._peers:
            if words[peer] != own:
                raise CollectiveError(
                    f"step {self.step}: GMI {ids[self._block.rank]} calls "
                    f"{_describe(int(own))}, GMI {ids[peer]} calls "
                    f"{_describe(int(words[peer]))}"
                )

    def end(self) -> None:
        """Closes the call that `begin` opened."""
        self._is_open = False

    def leave(self) -> None:
        """Marks this rank as gone: it makes no further calls."""
        self._block.lines["pid"][self._block.rank] = 0

    @property
    def limit_s(self) -> float:
        """Longest wait in the call that is open."""
        is_first = self.step <= self._first_step
        return self._rendezvous_timeout_s if is_first else self._timeout_s

    def _look_at_other_nodes(self, since_s: float) -> None:
        if self.other_nodes is not None:
            self.other_nodes.look(since_s, self.limit_s, self._operation, self.step)

    def _look_for_a_cause(self) -> None:
        detector, since_s = self._detector(), running_s()
        while running_s() < since_s + SETTLE_S:
            detector.look(lambda: self._peers)
            self._look_at_other_nodes(since_s)
            time.sleep(0.02)
        if unresponsive := detector.unresponsive(self._peers):
            detector.give_up(unresponsive)

    def arrive(self) -> None:
        """Arrives, without waiting."""
        self._fence()
        self._sequence[self._block.rank] += 1

    def _wait_for_all(self) -> None:
        self._wait()  # counters of 1: all have attached
        sizes, rank = self._block.lines["num_floats"], self._block.rank
        for peer in self._peers:
            if sizes[peer] != sizes[rank]:
                own, other = (f"GMI {self._block.ids[one]}" for one in (rank, peer))
                raise CollectiveError(
                    f"{own} and {other} do not fit together: num_floats is {sizes[rank]} for "
                    f"{own}, and {sizes[peer]} for {other}"
                )

    def _wait(self, *, while_unresponsive: bool = False, looks_at_nodes: bool = False) -> None:
        target, missing = int(self._sequence[self._block.rank]), self._peers
        detector, since_s = self._detector(), running_s()

        def arrived() -> bool | None:
            nonlocal missing
            missing = self._missing(missing, target)
            return None if missing else True

        def look() -> None:
            late = partial(self._missing, self._peers, target)
            detector.look(late, while_unresponsive=while_unresponsive)
            if looks_at_nodes:
                self._look_at_other_nodes(since_s)

        wait_until(arrived, look, math.inf)
        self._fence()

    def _detector(self) -> FailureDetector:
        detector = FailureDetector(self._block, self._operation, self.step, self.limit_s)
        if self.other_nodes is not None:
            detector.on_look = self.other_nodes.beat
        return detector

    def _missing(self, peers: list[int], target: int) -> list[int]:
        counter_of = self._sequence.item
        return [peer for peer in peers if counter_of(peer) < target]


def _describe(word: int) -> str:
    operation = OPERATIONS[word & (1 << COUNT_SHIFT) - 1]
    count = word >> COUNT_SHIFT & (1 << CALL_INDEX_SHIFT - COUNT_SHIFT) - 1
    call_index = word >> CALL_INDEX_SHIFT
    which = f" ({call_index:04x} of its program)" if call_index else ""
    return f"{operation} of {count} floats{which}"
