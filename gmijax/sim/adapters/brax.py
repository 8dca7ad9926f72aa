"""Environments of Brax: `env=brax env.name=ant`."""

from __future__ import annotations

from typing import Any

from brax import envs
from brax.envs.base import Env as BraxEnv

from gmijax.config.schema import suggestion
from gmijax.errors import ConfigError
from gmijax.sim.adapters.brax_interface import adapt
from gmijax.sim.interface import Env

EPISODE_LENGTH = 1000
"""Brax's own, in `brax.envs.create`."""


def make(name: str, *, impl: str = "auto", max_envs: int | None = None) -> Env:
    """Makes one of `brax.envs`, with Brax's backend `mjx` where it has that, else its default.

    Raises:
      ConfigError: an unknown name, or MJX-Warp.
    """
    del max_envs  # MJX-JAX has no limit.
    if impl == "warp":
        raise ConfigError("physics.impl=warp: Brax's tasks run in JAX; allowed: auto, jax")
    names = list(envs._envs)
    if name not in names:
        raise ConfigError(
            f"env.name={name}: Brax has no such environment{suggestion(name, names)}"
        )
    try:
        theirs = envs.get_environment(name, backend="mjx")
    except ValueError:  # The swimmer needs a drag that only Brax's own engines have.
        theirs = envs.get_environment(name)
    return from_brax(theirs, name=f"brax/{name}")


def from_brax(theirs: BraxEnv, *, name: str, episode_length: int = EPISODE_LENGTH) -> Env:
    """An environment of Brax, without its wrappers, as one of ours; see `brax_interface.adapt`."""
    system: Any = getattr(theirs, "sys", None)
    return adapt(
        theirs,
        name=name,
        episode_length=episode_length,
        mj_model=getattr(system, "mj_model", None),
        qpos=lambda state: state.pipeline_state.q,
    )
