"""The uni-channel design, the baseline of section 4.2: each experience alone, tensor by tensor.

One experience is what all environments of an agent see in one step. So a rollout of T steps with
C channels is T x C messages, which the trainer puts together. A channel with fewer steps comes
with the last ones. Same routing, back-pressure, checks and batches as with channels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gmijax.collectives.channel.compressor import Transfer
from gmijax.collectives.channel.dispenser import Piece
from gmijax.collectives.channel.interface import Array, Inlet, Outlet
from gmijax.collectives.channel.migrator import Migrator
from gmijax.collectives.channel.spec import Spec, write_channel
from gmijax.collectives.pipe import Message
from gmijax.errors import GmijaxError, PipeClosed


class _Tensor(NamedTuple):
    """Which tensor of a rollout a message holds."""

    step: int
    channel: int
    is_first: bool
    is_last: bool


def _tensors(spec: Spec) -> list[_Tensor]:
    """All tensors of a rollout in the order they are sent."""
    longest = max(channel.steps for channel in spec.channels)
    order = [
        (step - longest + channel.steps, place)
        for step in range(longest)
        for place, channel in enumerate(spec.channels)
        if step >= longest - channel.steps
    ]
    return [_Tensor(*at, is_first=at == order[0], is_last=at == order[-1]) for at in order]


class UniSender:
    """Takes the place of the compressor, see there.

    Args:
      migrator: gives every rollout its way.

    Attributes:
      transfers: messages sent.
      num_bytes: in their tensors.
    """

    def __init__(self, migrator: Migrator) -> None:
        self.transfers = self.num_bytes = 0
        self._migrator = migrator
        self._outlet: Outlet | None = None
        self._todo: list[_Tensor] = []

    def try_add(self, piece: Piece) -> bool:
        """Sends what there is room for; False: call it again with the same piece."""
        if not self._todo:
            self._outlet = None
            self._todo = _tensors(piece.spec)[::-1]
        while self._todo:
            if not self._try_send(piece, self._todo[-1]):
                return False
            self._todo.pop()
        return True

    def flush(self) -> None:
        """Nothing is ever held back."""

    def _try_send(self, piece: Piece, tensor: _Tensor) -> bool:
        spec, num_envs = piece.spec, piece.num_envs
        channel = spec.channels[tensor.channel]
        text = spec.encode()
        sizes = [len(text), 40, channel.wire_bytes(num_envs) // channel.steps]
        if self._outlet is None:
            opened = self._migrator.try_open(sizes)
            if opened is None:
                return False
            self._outlet, views = opened
        else:
            views = self._outlet.try_reserve(sizes)
            if views is None:
                return False
        views[0][:] = np.frombuffer(text, np.uint8)
        table = tensor.step, tensor.channel, tensor.is_first, num_envs, piece.version
        views[1].view(np.int64)[:] = table
        into = views[2].view(channel.wire_dtype).reshape(num_envs, *channel.shape)
        write_channel(into, piece.channels[channel.name][tensor.step])
        self._outlet.commit(items=int(tensor.is_last))
        self.transfers += 1
        self.num_bytes += sizes[2]
        return True


class UniSource:
    """Puts the rollouts of one agent together; a `Source` of the batcher.

    Attributes:
      peer: rank of the agent.
      transfers: messages that arrived.
      num_bytes: in their tensors.
      discarded: rollouts of which only a part came, because an end was killed.
    """

    def __init__(self, inlet: Inlet) -> None:
        self.peer = inlet.peer
        self.transfers = self.num_bytes = self.discarded = 0
        self._inlet = inlet
        self._arrays: dict[str, Array] = {}
        self._shape: tuple[Spec, int] | None = None
        self._is_begun = False

    def try_next(self) -> Transfer | None:
        """See `Source`."""
        try:
            while (message := self._inlet.try_get()) is not None:
                found = self._put(message)
                self._inlet.release()
                if found is not None:
                    self._is_begun = False
                    return found
        except PipeClosed:
            self._discard()
            raise
        return None

    def release(self) -> None:
        """The rollout lies in this source's own memory, until the next one begins."""

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        """See `Source`."""
        return self._inlet.why_lost(operation, step)

    def close(self) -> None:
        """Nothing is held."""

    def _put(self, message: Message) -> Transfer | None:
        spec = Spec.decode(message.parts[0].tobytes())
        step, place, is_first, num_envs, version = message.parts[1].view(np.int64).tolist()
        if is_first:
            self._discard()
            self._begin(spec, num_envs)
        if not self._is_begun:  # A predecessor of this trainer has read how it began.
            self.discarded += message.items
            return None
        # The order is the pipe's: what does not begin a rollout continues one.
        channel = spec.channels[place]
        values = message.parts[2].view(channel.wire_dtype).reshape(num_envs, *channel.shape)
        self._arrays[channel.name][step] = values
        self.transfers += 1
        self.num_bytes += message.parts[2].nbytes
        if not message.items:
            return None
        return Transfer(
            spec.unpacked(), num_envs, np.full(num_envs, version, np.int64), self._arrays
        )

    def _begin(self, spec: Spec, num_envs: int) -> None:
        self._is_begun = True
        if self._shape == (spec, num_envs):
            return  # Nobody reads the last rollout any more.
        self._shape = spec, num_envs
        self._arrays = {c.name: np.empty(c.full_shape(num_envs), c.dtype) for c in spec.channels}

    def _discard(self) -> None:
        self.discarded += self._is_begun
        self._is_begun = False
