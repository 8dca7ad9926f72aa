"""What agents and trainers see of the channels, and the two seams inside them.

An agent sends what it has experienced in one rollout, a trainer receives batches of it. A
*piece* is what the agents count: the experience of one `send`, or a part of its environments
where the whole is too large for the channel. A *transfer* is what travels: one or more pieces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.collectives.pipe import Bytes, Message
from gmijax.errors import GmijaxError

Array: TypeAlias = npt.NDArray[Any]
Experience: TypeAlias = Mapping[str, Array]
"""Arrays by channel, [S, N, ...] float32 or bool, of N environments.

S is the number of steps, or one more (the last state), or 1 (one value an unroll): channels may
differ in it.
"""


class Batch(NamedTuple):
    """What a trainer gets: whole unrolls of B environments.

    Attributes:
      experience: arrays by channel, [S, B, ...]; read-only views that are valid until the next
        `receive`, of host memory or of the device's. The latter are for programs: the same view
        comes again with other values, and jax keeps what `np.asarray` once read of it.
      versions: [B] int64, the policy version that every unroll was made with.
      agents: [B] int64, ranks of the agents that made them.
    """

    experience: dict[str, Array]
    versions: npt.NDArray[np.int64]
    agents: npt.NDArray[np.int64]


class SenderStats(NamedTuple):
    """Counts of one agent since it started.

    Attributes:
      pieces: handed over, dropped ones too.
      dropped: pieces that nobody gets, with `when_full=drop_oldest`; after `close` also those
        that still waited.
      transfers: messages committed.
      num_bytes: in all channels, as they travel.
      waited_s: time spent waiting for room.
      transfer_bytes: the size in use, chosen or found.
      occupancy: fullest of the ways to the trainers, 0 to 1.
      least_occupancy: emptiest of the ways that the next transfer may take, 0 to 1.
    """

    pieces: int
    dropped: int
    transfers: int
    num_bytes: int
    waited_s: float
    transfer_bytes: int
    occupancy: float
    least_occupancy: float


class ReceiverStats(NamedTuple):
    """Counts of one trainer since it started.

    Attributes:
      batches: given out.
      unrolls: environments' unrolls that arrived.
      transfers: messages that arrived.
      num_bytes: in all channels, as they travelled.
      waited_s: time spent waiting for experience.
      discarded: pieces of which an agent that ended had sent only a part (uni-channel).
      occupancy: fullest of the ways from the agents, 0 to 1.
    """

    batches: int
    unrolls: int
    transfers: int
    num_bytes: int
    waited_s: float
    discarded: int
    occupancy: float


class ExperienceSender(Protocol):
    """An agent's end of the channels.

    Attributes:
      on_device: whether it takes arrays of the device; otherwise numpy's.
    """

    on_device: bool

    def send(self, experience: Experience, version: int, timeout_s: float) -> bool:
        """Sends one rollout; the caller may change its arrays once that is done.

        Args:
          experience: arrays by channel; names, S, dtypes and what follows N stay the same.
          version: of the policy that acted.
          timeout_s: longest wait for room (`when_full=block`).

        Returns:
          False if no trainer made room in time. Then, and after an error, a part may have been
          sent: call it again with the same experience until it is done, or send nothing any more.

        Raises:
          PeerLost: the process of a trainer is gone.
          PipeClosed: a trainer has closed its end.
          ConfigError: not such arrays, or an unroll that is too large for the channel.
        """
        ...

    def flush(self) -> None:
        """Hands over what waits for more to come; trainers cannot see it before."""
        ...

    def stats(self) -> SenderStats:
        """Counts so far."""
        ...

    def close(self) -> None:
        """Flushes, and tells the trainers that nothing more comes; twice is fine."""
        ...


class ExperienceReceiver(Protocol):
    """A trainer's end of the channels."""

    def receive(self, batch_size: int, timeout_s: float) -> Batch:
        """Waits for the unrolls of `batch_size` environments.

        After any error nothing is lost: what had arrived is in the next batch. An agent that is
        gone is named at most five times a second, also while others still send; who can do
        without it goes on, and a successor with its rank continues.

        Raises:
          CollectiveTimeout: too few came in time.
          PeerLost: the process of an agent is gone.
          PipeClosed: all agents have closed, and too few are left.
          CollectiveError: a message is damaged.
        """
        ...

    def stats(self) -> ReceiverStats:
        """Counts so far."""
        ...

    def close(self) -> None:
        """Tells the agents that nothing more is wanted; twice is fine."""
        ...


class Outlet(Protocol):
    """A transport's way from this agent to one trainer.

    Attributes:
      peer: rank of the trainer.
      max_message_bytes: largest message, with header and alignment as `message_bytes` counts.
      sent_items: pieces committed since the way exists; through shared memory by predecessors of
        this process too.
    """

    peer: int
    max_message_bytes: int

    @property
    def sent_items(self) -> int:
        """Pieces committed, see above."""
        ...

    def try_reserve(self, sizes: Sequence[int]) -> list[Bytes] | None:
        """Memory for the parts of the next message, or None: no room now."""
        ...

    def commit(self, *, tag: int = 0, items: int = 1) -> None:
        """Sends what was reserved, made of `items` pieces."""
        ...

    def load_bytes(self) -> int:
        """Outstanding work of the trainer, from all agents as far as the transport knows."""
        ...

    def occupancy(self) -> float:
        """How full this way is, 0 to 1."""
        ...

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """Why the trainer will never read again, None if it may."""
        ...

    def close(self) -> None:
        """Nothing more comes."""
        ...


class Inlet(Protocol):
    """A transport's way from one agent to this trainer.

    Attributes:
      peer: rank of the agent.
    """

    peer: int

    def try_get(self) -> Message | None:
        """The next message, valid until `release`; PipeClosed if no more can come."""
        ...

    def release(self) -> None:
        """Gives the memory of the last message back."""
        ...

    def occupancy(self) -> float:
        """How full this way is, 0 to 1."""
        ...

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """Why the agent will never send again, None if it may."""
        ...

    def close(self) -> None:
        """Nothing more is wanted."""
        ...
