"""Which MJX implementation runs. No jax here: the controller decides and prints why."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

from gmijax.config.env import ROBOTS
from gmijax.errors import ConfigError

Impl = Literal["jax", "warp"]


class WarpSizes(NamedTuple):
    """Sizes of MJX-Warp's buffers.

    Attributes:
      contacts_per_env: the buffer that all environments share holds so many for each of them.
      constraints_per_env: rows of the constraint solver in one environment.
    """

    contacts_per_env: int
    constraints_per_env: int


ON_GPU: Mapping[str, WarpSizes | None] = MappingProxyType(
    {
        "ant": None,
        "anymal": None,
        "ball_balance": None,
        "franka_cabinet": None,
        "humanoid": None,
        # MJX-JAX keeps the 12 deepest contacts, Warp all: up to 10 under random actions, 20 fit.
        "shadow_hand": WarpSizes(contacts_per_env=12, constraints_per_env=108),
    }
)
"""Tasks for which `physics.impl=auto` chooses MJX-Warp on a GPU, and the sizes of its buffers.

None: sizes by the pairs of geoms that may touch (`gmijax/sim/warp/sizes.py`). A task that is not
here runs in JAX.
"""


_GIVEN = "set on the command line or by the run"


def impl_of_policy(wanted: str, trained_with: str | None) -> str:
    """What to ask for where a policy is played: it may depend on what it was trained with."""
    return "jax" if wanted == "auto" and trained_with == "jax" else wanted


def choose_impl(
    impl: str,
    device_platform: str,
    task: str | None = None,
    *,
    warp_installed: bool | None = None,
) -> tuple[Impl, str]:
    """Decides which MJX implementation runs, and why, in a sentence.

    Args:
      impl: `auto`, `jax` or `warp`.
      device_platform: JAX's name of the device: `cpu`, `gpu` or `cuda`.
      task: its name; None, or one that `ON_GPU` does not have, for a task of the user's.
      warp_installed: whether warp-lang can be imported; None to find out.

    Raises:
      ConfigError: an unknown implementation, or `warp` without warp-lang.
    """
    if impl not in ("auto", "jax", "warp"):
        raise ConfigError(f"physics.impl={impl}: expected one of auto, jax, warp")
    if warp_installed is None:
        warp_installed = importlib.util.find_spec("warp") is not None
    if impl == "jax":
        return "jax", _GIVEN
    is_gpu = device_platform in ("gpu", "cuda")
    if impl == "warp":
        if not warp_installed:
            raise ConfigError(
                "physics.impl=warp: needs the package warp-lang (pip install 'gmijax[warp]'); "
                "without it, use physics.impl=auto"
            )
        return "warp", _GIVEN
    if not is_gpu:
        return "jax", f"MJX-Warp is slow on {device_platform}"
    if task in ON_GPU:
        why = f"the faster one for {task} on a GPU"
    elif task is not None and (task in ROBOTS or task.startswith("playground/")):
        why = "what MuJoCo Playground itself chooses"
    else:
        return "jax", "not tuned for MJX-Warp; ask for it with physics.impl=warp"
    if warp_installed:
        return "warp", why
    return "jax", f"warning: warp, {why}, needs warp-lang (pip install 'gmijax[warp]')"
