"""Runs a step on the devices of all ranks, between two barriers, and watches the peers meanwhile.

On several nodes the barrier before a step is of the ranks of each, that after it of all; meanwhile
the leaders watch each other: a device that waits for another node in a ring reports nothing.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable
from typing import TypeVar

from gmijax.collectives.all_or_none import Group
from gmijax.collectives.device.watched_thread import WatchedThread, end_at_once
from gmijax.collectives.nodes.multi_node_group import MultiNodeGroup

T = TypeVar("T")


class LockstepRunner:
    """One rank's part in steps of all ranks, which must agree on `num_floats`."""

    def __init__(self, group: Group, num_floats: int) -> None:
        self._group, self._barrier = group, group.local.barrier
        self._num_floats = num_floats
        self._thread = WatchedThread()
        self._is_running = False

    @property
    def is_caught(self) -> bool:
        """Whether the device may be in an exchange that a peer has not reached."""
        return self._thread.is_stuck or self._is_running

    def step(self, program: Callable[[], T]) -> T:
        """Runs a program that queues a step of all.

        From the first one until `finish` the device may be at it, and wait for a peer that is
        gone: what ends this process meanwhile, wherever it is found, ends it at once.

        Raises:
          PeerLost, CollectiveTimeout: see `Barrier.watch`; errors that no peer explains stay.
        """
        if not self._is_running:
            self._is_running = True
            atexit.register(end_at_once)
        barrier = self._barrier
        barrier.begin("step", self._num_floats)
        barrier.wait()
        barrier.check_same_call()
        with barrier.raise_peer_failure():
            result = self._thread.run(program, barrier.watch)
        # Some have given it to their devices a step before others. Those may be in a ring with
        # another node; not so after the barrier, when that node may have ended as it should.
        barrier.wait(while_unresponsive=True, looks_at_nodes=True)
        if isinstance(self._group, MultiNodeGroup):
            self._group.leader_barrier()
            barrier.wait(while_unresponsive=True)
        barrier.end()
        return result

    def finish(self, program: Callable[[], T]) -> T:
        """Runs a program that returns when all steps are computed; raises as `step`."""
        result = self.step(program)
        self._is_running = False
        atexit.unregister(end_at_once)
        return result

    def close(self) -> None:
        """Ends the thread. Idempotent."""
        self._thread.close()
