"""The two ends of the channels, put together from their parts."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Protocol

from gmijax.collectives.channel.backlog import Block, DropOldest
from gmijax.collectives.channel.batcher import Batcher, Stack
from gmijax.collectives.channel.compressor import Compressor, Transfer, read_transfer
from gmijax.collectives.channel.dispenser import Dispenser
from gmijax.collectives.channel.interface import (
    Batch,
    Experience,
    Inlet,
    ReceiverStats,
    SenderStats,
)
from gmijax.collectives.channel.migrator import Migrator
from gmijax.collectives.channel.spec import Spec
from gmijax.collectives.channel.transfer_size import TransferSize
from gmijax.collectives.channel.unichannel import UniSender
from gmijax.errors import GmijaxError

CLOSE_TIMEOUT_S = 5.0
"""How long an agent that closes waits for room for what it has queued."""


class Sender:
    """An agent's end; see `ExperienceSender`.

    Args:
      dispenser: splits rollouts.
      taker: the compressor, or the uni-channel in its place.
      migrator: the ways to the trainers.
      pressure: what to do without room.
      size: of transfers; None with the uni-channel.
      leave: called at the end.
    """

    on_device = False

    def __init__(
        self,
        dispenser: Dispenser,
        taker: Compressor | UniSender,
        migrator: Migrator,
        pressure: Block | DropOldest,
        size: TransferSize | None,
        leave: Callable[[], None],
    ) -> None:
        self._dispenser = dispenser
        self._taker = taker
        self._migrator = migrator
        self._pressure = pressure
        self._size = size
        self._leave = leave
        self._pieces = 0
        self._is_pending = False
        self._is_open = True

    @property
    def sent_pieces(self) -> int:
        """Pieces that trainers have got or will get.

        Through shared memory those of predecessors with this rank are included.
        """
        return self._migrator.sent_items

    def send(self, experience: Experience, version: int, timeout_s: float) -> bool:
        """See `ExperienceSender`."""
        self._migrator.check()
        pieces = []
        if not self._is_pending:  # Otherwise the same rollout as before: it is split already.
            pieces = list(self._dispenser.split(experience, version))
            self._pieces += len(pieces)
        self._is_pending = True  # Also after an error: some of it may have been sent.
        self._is_pending = not self._pressure.add(pieces, timeout_s)
        return not self._is_pending

    def flush(self) -> None:
        """See `ExperienceSender`."""
        self._taker.flush()

    def stats(self) -> SenderStats:
        """See `ExperienceSender`."""
        return SenderStats(
            pieces=self._pieces,
            dropped=self._pressure.dropped,
            transfers=self._taker.transfers,
            num_bytes=self._taker.num_bytes,
            waited_s=self._pressure.waited_s,
            transfer_bytes=0 if self._size is None else self._size.num_bytes,
            occupancy=self._migrator.occupancy() if self._is_open else 0.0,
            least_occupancy=self._migrator.least_occupancy() if self._is_open else 0.0,
        )

    def close(self) -> None:
        """See `ExperienceSender`."""
        if not self._is_open:
            return
        self._is_open = False
        with contextlib.suppress(GmijaxError):  # A trainer that is gone wants nothing.
            self._pressure.drain(CLOSE_TIMEOUT_S)
        self._taker.flush()  # Another one may.
        self._migrator.close()
        self._leave()


class CountingSource(Protocol):
    """A `Source` of the batcher that counts."""

    peer: int
    transfers: int
    num_bytes: int
    discarded: int

    def try_next(self) -> Transfer | None:
        """See `Source`."""
        ...

    def release(self) -> None:
        """See `Source`."""
        ...

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """See `Source`."""
        ...

    def close(self) -> None:
        """Nothing is read any more."""
        ...


class TransferSource:
    """Reads the compressor's transfers; a `CountingSource`."""

    def __init__(self, inlet: Inlet) -> None:
        self.peer = inlet.peer
        self.transfers = self.num_bytes = self.discarded = 0
        self._inlet = inlet

    def try_next(self) -> Transfer | None:
        """See `Source`."""
        message = self._inlet.try_get()
        if message is None:
            return None
        transfer = read_transfer(message.parts)
        self.transfers += 1
        self.num_bytes += sum(transfer.spec.sizes(transfer.num_envs))
        return transfer

    def release(self) -> None:
        """See `Source`."""
        self._inlet.release()

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """See `Source`."""
        return self._inlet.why_lost(operation, step)

    def close(self) -> None:
        """See `CountingSource`: nothing is held."""


class Receiver:
    """A trainer's end; see `ExperienceReceiver`.

    Args:
      rank: of this trainer.
      inlets: the ways from all agents.
      make: what reads an inlet, as the agents write.
      new_stack: see `Batcher`.
      leave: called at the end.
    """

    def __init__(
        self,
        rank: int,
        inlets: Sequence[Inlet],
        *,
        make: Callable[[Inlet], CountingSource],
        new_stack: Callable[[Spec, int], Stack] = Stack,
        leave: Callable[[], None],
    ) -> None:
        self._inlets = list(inlets)
        self._sources = [make(inlet) for inlet in inlets]
        self._batcher = Batcher(rank, self._sources, new_stack)
        self._leave = leave
        self._is_open = True

    def receive(self, batch_size: int, timeout_s: float) -> Batch:
        """See `ExperienceReceiver`."""
        return self._batcher.receive(batch_size, timeout_s)

    def stats(self) -> ReceiverStats:
        """See `ExperienceReceiver`."""
        return ReceiverStats(
            batches=self._batcher.batches,
            unrolls=self._batcher.unrolls,
            transfers=sum(source.transfers for source in self._sources),
            num_bytes=sum(source.num_bytes for source in self._sources),
            waited_s=self._batcher.waited_s,
            discarded=sum(source.discarded for source in self._sources),
            occupancy=max(inlet.occupancy() for inlet in self._inlets) if self._is_open else 0.0,
        )

    def close(self) -> None:
        """See `ExperienceReceiver`."""
        if self._is_open:
            self._is_open = False
            for source, inlet in zip(self._sources, self._inlets, strict=True):
                source.close()
                inlet.close()
            self._leave()
