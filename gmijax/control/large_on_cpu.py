"""The warning for a training that is large for a machine without a GPU."""

from __future__ import annotations

from typing import Final

from gmijax.config import TrainConfig

_MANY_ENVS: Final = 2048
_MANY_STEPS: Final = 10_000_000
"""From both of these on settings are for a GPU: all that are shipped for robots."""

_SMALL: Final = "num_envs=64", "num_timesteps=1e5"


def large_on_cpu(config: TrainConfig, *, on_cpu: bool) -> tuple[str, ...]:
    """A warning, and what to add for a small try; nothing where a GPU is used or not needed."""
    num_envs, steps = config.num_envs, config.num_timesteps
    if not on_cpu or num_envs == "auto" or num_envs < _MANY_ENVS or steps < _MANY_STEPS:
        return ()
    small = " ".join((*_SMALL, *config.algo.small_keys))
    return (
        f"warning: {num_envs:,} environments for {steps:,} steps are meant for a GPU, and can "
        f"take hours on a CPU: the ETA follows once it trains; for a small try add {small}",
    )
