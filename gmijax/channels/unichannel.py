"""The uni-channel design, the baseline of section 4.2: each experience alone, tensor by tensor.

One experience is what all environments of an agent see in one step. So a rollout of T steps with
C channels is T x C messages, which the trainer puts together. A channel with fewer steps comes
with the last ones. Same routing, back-pressure, checks and batches as with channels.

The parts of a message are the spec, a table (step, channel, N, policy version, whether it is the
last of its rollout), and the tensor.
"""

from __future__ import annotations

import numpy as np

from gmijax.channels.experience import Array, Rollouts, Spec
from gmijax.channels.migrator import ChannelWriter, Migrator
from gmijax.channels.pipe import Message


class UniPacker:
    """Replaces the compressor; a `MessageEncoder`."""

    def __init__(self, migrator: Migrator) -> None:
        self._migrator = migrator
        self._writer: ChannelWriter | None = None
        self._todo: list[tuple[int, int]] = []

    def try_add(self, piece: Rollouts) -> bool:
        """Sends what fits now; False: call it again with the same piece."""
        if not self._todo:
            self._writer = None
            self._todo = _tensors(piece.spec)
        while self._todo:
            if not self._try_send(piece, *self._todo[-1]):
                return False
            self._todo.pop()
        return True

    def flush(self) -> None:
        """Nothing is ever held back."""

    def _try_send(self, piece: Rollouts, step: int, index: int) -> bool:
        channel = piece.spec.channels[index]
        head = piece.spec.encode()
        sizes = [head.size, 40, channel.num_bytes(piece.num_envs) // channel.steps]
        if self._writer is None:  # All of a rollout go to one trainer.
            opened = self._migrator.try_open(sizes)
        else:
            views = self._writer.try_reserve(sizes)
            opened = None if views is None else (self._writer, views)
        if opened is None:
            return False
        self._writer, views = opened
        views[0][:] = head
        is_last = len(self._todo) == 1
        views[1].view(np.int64)[:] = step, index, piece.num_envs, piece.versions[0], is_last
        into = views[2].view(channel.dtype).reshape(piece.num_envs, *channel.shape)
        into[...] = piece.experience[channel.name][step]
        self._writer.commit()
        return True


class UniDecoder:
    """Puts the rollouts of one agent together, in memory that the next one uses; a `Decode`."""

    def __init__(self) -> None:
        self._arrays: dict[str, Array] = {}
        self._shape: tuple[Spec, int] | None = None

    def __call__(self, message: Message, agent: int) -> Rollouts | None:
        """The rollout of which `message` is the last tensor; None before."""
        head, table, tensor = message
        spec = Spec.decode(head)
        step, index, num_envs, version, is_last = table.view(np.int64).tolist()
        if self._shape != (spec, num_envs):
            self._shape = spec, num_envs
            self._arrays = {
                c.name: np.empty(c.full_shape(num_envs), c.dtype) for c in spec.channels
            }
        channel = spec.channels[index]
        values = tensor.view(channel.dtype).reshape(num_envs, *channel.shape)
        self._arrays[channel.name][step] = values
        if not is_last:
            return None
        versions, agents = (np.full(num_envs, one, np.int64) for one in (version, agent))
        return Rollouts(spec, self._arrays, versions, agents)


def _tensors(spec: Spec) -> list[tuple[int, int]]:
    """(step, index of the channel) of all tensors of a rollout; the last one is sent first."""
    longest = max(channel.steps for channel in spec.channels)
    order = [
        (step - longest + channel.steps, index)
        for step in range(longest)
        for index, channel in enumerate(spec.channels)
        if step >= longest - channel.steps
    ]
    return order[::-1]
