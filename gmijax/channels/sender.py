"""An agent's end of the channels, with back-pressure: without room it waits."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from dataclasses import dataclass
from typing import Protocol

from gmijax.channels.dispenser import Dispenser, Piece
from gmijax.channels.migrator import Migrator
from gmijax.channels.spec import Experience
from gmijax.clock import running_s
from gmijax.collectives.waits import wait_until
from gmijax.errors import GmijaxError

CLOSE_TIMEOUT_S = 5.0
"""How long an agent that closes waits for room for what it has not sent yet."""


class Packer(Protocol):
    """What makes messages of pieces: a `Compressor`, a `UniPacker` or a `ResidentPacker`."""

    def try_add(self, piece: Piece) -> bool:
        """Takes `piece`, or says that there is no room; then the same piece must come again."""
        ...

    def flush(self) -> None:
        """Hands over what waits for more to come."""


@dataclass
class Sender:
    """An agent's end of the channels; `held` is closed with it.

    Attributes:
      on_device: whether it takes arrays of the device; otherwise numpy's.
      num_bytes: sent, in all channels.
      waited_s: time spent waiting for room.
    """

    dispenser: Dispenser
    packer: Packer
    migrator: Migrator
    on_device: bool
    held: contextlib.ExitStack

    def __post_init__(self) -> None:
        self.num_bytes = 0
        self.waited_s = 0.0
        self._waiting: deque[Piece] = deque()
        self._is_open = True

    def send(self, experience: Experience, version: int, timeout_s: float) -> bool:
        """Sends one rollout; the caller may change its arrays once that is done.

        Args:
          experience: arrays by channel; names, S, dtypes and what follows N stay the same.
          version: of the policy that acted.
          timeout_s: longest wait for room.

        Returns:
          False if no trainer made room in time. Then, and after an error, call it again with the
          same experience until it is done: a part may have been sent.

        Raises:
          PeerLost: the process of a trainer is gone.
          PipeClosed: a trainer has closed its end.
          ConfigError: not such arrays, or an unroll that is too large for the channel.
          CudaError: memory of the GPU cannot be shared.
        """
        self.migrator.check()
        if not self._waiting:  # Else it is the same rollout as before, of which this is left.
            self._waiting.extend(self.dispenser.split(experience, version))
        return self._drain(timeout_s)

    def flush(self) -> None:
        """Hands over what waits for more to come; trainers cannot see it before."""
        self.packer.flush()

    def occupancy(self) -> float:
        """Of the fullest way to a trainer, 0 to 1."""
        return self.migrator.occupancy()

    def least_occupancy(self) -> float:
        """Of the emptiest way that the next transfer may take, 0 to 1."""
        return self.migrator.least_occupancy()

    def close(self) -> None:
        """Flushes, and tells the trainers that nothing more comes. Idempotent.

        With `transport=device` it waits a while for trainers: what they have not read goes with
        this process.
        """
        if not self._is_open:
            return
        self._is_open = False
        with contextlib.suppress(GmijaxError):  # Nothing to send to a trainer that is gone.
            self._drain(CLOSE_TIMEOUT_S)
        self.packer.flush()  # Another one may.
        self.held.close()

    def _drain(self, timeout_s: float) -> bool:
        """Whether all that waits was taken in time."""
        deadline_s = running_s() + timeout_s
        while self._waiting:
            if not self._try_add(self._waiting[0]) and not self._wait(deadline_s):
                return False
            self._waiting.popleft()
        return True

    def _wait(self, deadline_s: float) -> bool:
        """Waits until the first piece is taken."""
        piece, started_s = self._waiting[0], time.monotonic()
        try:
            took = wait_until(
                lambda: self._try_add(piece) or None,
                self.migrator.why_lost,
                deadline_s - running_s(),
            )
        finally:
            self.waited_s += time.monotonic() - started_s
        return took is not None

    def _try_add(self, piece: Piece) -> bool:
        is_taken = self.packer.try_add(piece)
        self.num_bytes += is_taken * sum(piece.spec.sizes(piece.num_envs))
        return is_taken
