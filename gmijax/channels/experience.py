"""Experience by channel: what agents send and trainers get.

All experience of one agent has the same spec: channels, numbers of steps, shapes, dtypes. It
travels with every message, so that trainers need not know it before.

A *piece* is the experience of one `send`, or a part of its environments where the whole is too
large for the channel. A *transfer* is what travels: one or more pieces.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.channels.pipe import Bytes
from gmijax.errors import ConfigError

Array: TypeAlias = npt.NDArray[Any]
Experience: TypeAlias = Mapping[str, Array]
"""Arrays by channel, [S, N, ...] float32 or bool, of N environments.

S is the number of steps, or one more (the last state), or 1 (one value an unroll): channels may
differ in it.
"""

DTYPES = ("float32", "bool")

VERSION_BYTES = 8
"""Of the policy version that goes with every rollout."""


class Channel(NamedTuple):
    """One kind of data, e.g. `state`: S steps, `shape` follows S and N, of one of `DTYPES`."""

    name: str
    steps: int
    shape: tuple[int, ...]
    dtype: str

    def full_shape(self, num_envs: int) -> tuple[int, ...]:
        """[S, N, ...]."""
        return (self.steps, num_envs, *self.shape)

    def num_bytes(self, num_envs: int) -> int:
        """Bytes of such an array."""
        return math.prod(self.full_shape(num_envs)) * np.dtype(self.dtype).itemsize


class Spec(NamedTuple):
    """The channels, in the order they travel."""

    channels: tuple[Channel, ...]

    def sizes(self, num_envs: int) -> list[int]:
        """Bytes of every channel."""
        return [channel.num_bytes(num_envs) for channel in self.channels]

    def arrays_in(self, parts: Sequence[Bytes], num_envs: int) -> dict[str, Array]:
        """Arrays by channel that lie in `parts`, the bytes of every channel."""
        return {
            channel.name: part.view(channel.dtype).reshape(channel.full_shape(num_envs))
            for channel, part in zip(self.channels, parts, strict=True)
        }

    def encode(self) -> Bytes:
        """As bytes; `decode` is the way back."""
        return np.frombuffer(json.dumps(self).encode(), np.uint8)

    @staticmethod
    def decode(data: Bytes) -> Spec:
        """The spec that `encode` wrote."""
        return _decode(data.tobytes())


class Rollouts(NamedTuple):
    """Rollouts of N environments: a piece, a transfer as it arrives, and a trainer's batch.

    Attributes:
      spec: their channels.
      experience: arrays by channel, [S, N, ...]; of host memory or of the device's.
      versions: [N] int64, the policy version that every rollout was made with.
      agents: [N] int64, ranks of the agents that made them.
    """

    spec: Spec
    experience: dict[str, Any]
    versions: npt.NDArray[np.int64]
    agents: npt.NDArray[np.int64]

    @property
    def num_envs(self) -> int:
        """N."""
        return len(self.versions)

    @property
    def num_bytes(self) -> int:
        """Bytes of all channels."""
        return sum(self.spec.sizes(self.num_envs))

    def part(self, low: int, high: int) -> Rollouts:
        """Those of environments `low` to `high`; in host memory views of these arrays."""
        if high - low == self.num_envs:  # A part of an array on a device is a copy.
            return self
        arrays = {name: array[:, low:high] for name, array in self.experience.items()}
        return Rollouts(self.spec, arrays, self.versions[low:high], self.agents[low:high])


@lru_cache(maxsize=64)
def _decode(text: bytes) -> Spec:
    (channels,) = json.loads(text)
    return Spec(
        tuple(Channel(name, steps, tuple(shape), dtype) for name, steps, shape, dtype in channels)
    )


def spec_of(experience: Experience) -> tuple[Spec, int]:
    """The spec of `experience`, and its number of environments.

    Raises:
      ConfigError: arrays that are not [S, N, ...] float32 or bool, or differ in N.
    """
    num_envs = next((array.shape[1] for array in experience.values() if array.ndim > 1), 0)
    channels = []
    for name, array in experience.items():
        is_right = array.ndim > 1 and array.shape[1] == num_envs and array.size
        if not is_right or array.dtype.name not in DTYPES:
            raise ConfigError(
                f"experience.{name}: got {array.dtype} {list(array.shape)}, expected float32 or "
                f"bool [S, {num_envs or 'N'}, ...]"
            )
        channels.append(Channel(name, array.shape[0], array.shape[2:], array.dtype.name))
    if not channels:
        raise ConfigError("experience: has no channels")
    return Spec(tuple(channels)), num_envs
