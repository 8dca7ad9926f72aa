"""An agent's end of the channels: the dispenser, and back-pressure, which waits for space."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from gmijax.channels.experience import VERSION_BYTES, Experience, Rollouts, Spec, spec_of
from gmijax.channels.migrator import Migrator
from gmijax.clock import running_s
from gmijax.collectives.waits import wait_until
from gmijax.errors import ConfigError, GmijaxError

CLOSE_TIMEOUT_S = 5.0
"""How long an agent that closes waits for space for what it has not sent yet."""


class MessageEncoder(Protocol):
    """What makes messages of pieces: a `Compressor`, a `UniPacker` or a `ResidentPacker`."""

    def try_add(self, piece: Rollouts) -> bool:
        """Takes `piece`; False: there is no space, and the same piece must be passed again."""
        ...

    def flush(self) -> None:
        """Hands over what waits for more to come."""


class Dispenser:
    """Categorises what an agent sends: pieces with one array a channel (DP, section 4.2).

    Args:
      rank: of the agent.
      max_piece_bytes: largest piece; a rollout beyond it is cut between environments. None: it
        stays whole, and its arrays where they are, on the host or the device.
    """

    def __init__(self, rank: int, max_piece_bytes: int | None) -> None:
        self._rank = rank
        self._max_piece_bytes = max_piece_bytes
        self._spec: Spec | None = None

    def split(self, experience: Experience | Any, version: int) -> list[Rollouts]:
        """The pieces of one rollout (a mapping or a NamedTuple), in order of environment.

        Raises:
          ConfigError: not such arrays, others than the first time, or too large ones.
        """
        by_channel = experience if isinstance(experience, Mapping) else experience._asdict()
        channels = dict(by_channel)
        if self._max_piece_bytes is not None:
            channels = {name: np.asarray(values) for name, values in by_channel.items()}
        spec, num_envs = spec_of(channels)
        if self._spec is None:
            self._spec = spec
        if spec != self._spec:
            raise ConfigError(f"experience: got {spec}, the first was {self._spec}")
        versions = np.full(num_envs, version, np.int64)
        whole = Rollouts(spec, channels, versions, np.full(num_envs, self._rank, np.int64))
        if self._max_piece_bytes is None:
            return [whole]
        one, most = sum(spec.sizes(1)), self._max_piece_bytes
        if one > most:
            raise ConfigError(
                f"experience: {one} bytes for one environment, at most {most}; "
                "channel.capacity_mib must be larger, or the unroll shorter"
            )
        pieces = -(-num_envs // max(1, most // (one + VERSION_BYTES)))
        step = -(-num_envs // pieces)  # As equal as can be.
        starts = range(0, num_envs, step)
        return [whole.part(low, min(low + step, num_envs)) for low in starts]


@dataclass
class Sender:
    """An agent's end of the channels; `held` is closed with it.

    Attributes:
      on_device: whether it takes arrays of the device; otherwise numpy's.
      num_bytes: sent, in all channels.
      waited_s: time spent waiting for space.
    """

    dispenser: Dispenser
    packer: MessageEncoder
    migrator: Migrator
    on_device: bool
    held: contextlib.ExitStack

    def __post_init__(self) -> None:
        self.num_bytes = 0
        self.waited_s = 0.0
        self._waiting: deque[Rollouts] = deque()
        self._is_open = True

    def send(self, experience: Experience | Any, version: int, timeout_s: float) -> bool:
        """Sends one rollout; the caller may change its arrays once that is done.

        Args:
          experience: arrays by channel, as a mapping or a NamedTuple; names, S, dtypes and what
            follows N stay the same.
          version: of the policy that acted.
          timeout_s: longest wait for space.

        Returns:
          False if no trainer freed space in time. Then, and after an error, call it again with the
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
        """Flushes, and announces to the trainers that nothing more comes. Idempotent.

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

    def _try_add(self, piece: Rollouts) -> bool:
        is_taken = self.packer.try_add(piece)
        self.num_bytes += is_taken * piece.num_bytes
        return is_taken
