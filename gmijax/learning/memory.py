"""Whether arrays fit into memory, before they are made."""

from __future__ import annotations

import math

import jax

from gmijax.devices import memory_limit_bytes
from gmijax.errors import ConfigError
from gmijax.learning.saved_arrays import size_bytes
from gmijax.machine.host_limits import detect_host
from gmijax.types import PyTree


def memory_bytes() -> float | None:
    """Memory that this process may use for arrays; None where that is unknown."""
    if jax.local_devices()[0].platform != "cpu":
        return memory_limit_bytes()
    host_mib = detect_host().memory_mib
    return None if host_mib is None else host_mib * 2**20


def in_gib(num_bytes: float) -> str:
    """A size for people."""
    return f"{num_bytes / 2**30:.3g} GiB"


def require_memory(key: str, num_envs: int, state: PyTree) -> None:
    """Raises ConfigError if the state of so many environments is more than the memory.

    Args:
      key: what sets their number.
      num_envs: N.
      state: of all of them, arrays or their shapes and dtypes.
    """
    limit, least = memory_bytes(), size_bytes(state)
    if limit is not None and least > limit:
        raise ConfigError(
            f"{key}: {num_envs} environments in one process would need more than "
            f"{in_gib(least)}, and there is {in_gib(limit)}; fewer than "
            f"{math.ceil(limit * num_envs / least)} can fit"
        )
