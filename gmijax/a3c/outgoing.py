"""What an agent has made, on its way to the trainers: room, waits, and no more than is wanted."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from gmijax.collectives.channel.sender import Sender
from gmijax.config import A3cConfig, TrainConfig

_POLL_S = 0.0002
_SLICE_S = 0.5
"""Longest wait for room before the agent looks for orders again."""


class Outgoing:
    """The agent's end of the channels, with `algo.max_ahead`.

    Args:
      config: of the run.
      algo: of the run, too.
      sender: the channels.

    Attributes:
      waited_s: seconds of waits for room in which the device had nothing to do.
    """

    def __init__(self, config: TrainConfig, algo: A3cConfig, sender: Sender) -> None:
        self.waited_s = 0.0
        self._channel = config.channel
        self._max_ahead = algo.max_ahead
        self._sender = sender

    def offer(self, arrays: Mapping[str, Any], version: int, is_idle: Callable[[], bool]) -> bool:
        """Whether the channels took an unroll within a moment; else offer it again.

        Args:
          arrays: of the unroll, by channel.
          version: of the policy that made it.
          is_idle: whether the device has computed all that it was given.

        Raises:
          PeerLost, PipeClosed: as `Sender.send`.
        """
        if self._is_ahead(arrays, is_idle):
            return False
        costs, before_s = is_idle(), self._sender.waited_s
        is_sent = self._sender.send(arrays, version, _SLICE_S)
        if costs:
            self.waited_s += self._sender.waited_s - before_s
        return is_sent

    def flush_if_starving(self) -> None:
        """Hands over what waits for more to come if a trainer has nothing to do."""
        if not self._sender.least_occupancy():
            self._sender.flush()

    def _is_ahead(self, arrays: Mapping[str, Any], is_idle: Callable[[], bool]) -> bool:
        """Waits a moment while `max_ahead` unrolls wait for every trainer; whether they still do.

        More of them in the channel would only make experience older.
        """
        if self._channel.when_full != "block":
            return False
        size = sum(array.nbytes for array in arrays.values())
        most = (self._max_ahead - 0.5) * size / self._channel.capacity_bytes
        deadline_s = time.monotonic() + _SLICE_S
        while self._sender.least_occupancy() > most:
            costs, now_s = is_idle(), time.monotonic()
            if now_s > deadline_s:
                return True
            time.sleep(_POLL_S)
            if costs:
                self.waited_s += time.monotonic() - now_s
        return False
