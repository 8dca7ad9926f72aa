"""Dispenser, on the agent's side: categorises experience into channels (paper, section 4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from gmijax.channels.spec import Array, Experience, Spec, spec_of
from gmijax.errors import ConfigError


class Piece(NamedTuple):
    """Experience of N environments, made with one version of the policy.

    Its arrays are views of what the agent gave.
    """

    spec: Spec
    num_envs: int
    version: int
    channels: dict[str, Array]


class Dispenser:
    """Splits what an agent sends into pieces with one array a channel.

    Args:
      max_piece_bytes: largest piece; a rollout beyond it is cut between environments. None: it
        stays whole, and its arrays where they are, on the host or the device.
    """

    def __init__(self, max_piece_bytes: int | None) -> None:
        self._max_piece_bytes = max_piece_bytes
        self._spec: Spec | None = None

    def split(self, experience: Experience | Any, version: int) -> list[Piece]:
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
        if self._max_piece_bytes is None:
            return [Piece(self._spec, num_envs, version, channels)]
        one, most = sum(spec.sizes(1)), self._max_piece_bytes
        if one > most:
            raise ConfigError(
                f"experience: {one} bytes for one environment, at most {most}; "
                "channel.capacity_mib must be larger, or the unroll shorter"
            )
        pieces = -(-num_envs // (most // one))
        step = -(-num_envs // pieces)  # As equal as can be.
        found = []
        for low in range(0, num_envs, step):
            high = min(low + step, num_envs)
            part = {name: array[:, low:high] for name, array in channels.items()}
            found.append(Piece(self._spec, high - low, version, part))
        return found
