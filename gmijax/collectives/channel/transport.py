"""The seams inside the channels: what a transport is, and what fills and reads its messages.

An agent sends what it has experienced in one rollout, a trainer receives batches of it. A
*piece* is what the agents count: the experience of one `send`, or a part of its environments
where the whole is too large for the channel. A *transfer* is what travels: one or more pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from gmijax.collectives.messages.pipe import Bytes, Message
from gmijax.errors import GmijaxError


class ChannelWriter(Protocol):
    """A transport's way from this agent to one trainer: a `PipeWriter`, or a `RemoteWriter`.

    Attributes:
      peer: rank of the trainer.
    """

    peer: int

    def try_reserve(self, sizes: Sequence[int]) -> list[Bytes] | None:
        """Memory for the parts of the next message; None if there is no room now."""
        ...

    def commit(self, *, tag: int = 0) -> None:
        """Sends what was reserved."""
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
        """Nothing more comes. Idempotent."""
        ...


class ChannelReader(Protocol):
    """A transport's way from one agent to this trainer: a `PipeReader`, or a `RemoteReader`.

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

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """Why the agent will never send again, None if it may."""
        ...

    def close(self) -> None:
        """Nothing more is wanted. Idempotent."""
        ...
