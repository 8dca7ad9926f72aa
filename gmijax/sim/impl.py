"""Which MJX implementation runs. No jax here: the controller decides and says why."""

from __future__ import annotations

import importlib.util
from typing import Literal

from gmijax.errors import ConfigError

Impl = Literal["jax", "warp"]


def choose_impl(
    impl: str, device_platform: str, *, warp_installed: bool | None = None
) -> tuple[Impl, str]:
    """Decides which MJX implementation runs, and says why in a sentence.

    Args:
      impl: `auto`, `jax` or `warp`.
      device_platform: JAX's name of the device: `cpu`, `gpu` or `cuda`.
      warp_installed: whether warp-lang can be imported; None to find out.

    Raises:
      ConfigError: an unknown implementation, or `warp` without warp-lang.
    """
    if impl not in ("auto", "jax", "warp"):
        raise ConfigError(f"physics.impl={impl}: allowed are auto, jax, warp")
    if warp_installed is None:
        warp_installed = importlib.util.find_spec("warp") is not None
    if impl == "jax":
        return "jax", "asked for"
    if impl == "warp":
        if not warp_installed:
            raise ConfigError(
                "physics.impl=warp: needs the package warp-lang (pip install 'gmijax[warp]'); "
                "allowed without it are auto, jax"
            )
        return "warp", "asked for"
    if device_platform not in ("gpu", "cuda"):
        return "jax", f"MJX-Warp is slow on {device_platform}"
    if not warp_installed:
        return "jax", "warp-lang is not installed"
    # No task has been trained with MJX-Warp on a GPU yet, and solver settings are tuned for jax.
    return "jax", "no task is tuned for MJX-Warp yet; ask for it with physics.impl=warp"
