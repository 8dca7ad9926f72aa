"""What XLA needs in its environment for physics on a CPU; it is read when jax starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from gmijax.version import numbers_of, versions_of

XLA_FLAGS: Final = "XLA_FLAGS"
POOL: Final = "PJRT_NPROC"
"""Threads of XLA's pool."""

_SMALLEST_POOL = 4

_FUSION_EMITTERS = "--xla_cpu_use_fusion_emitters"
"""Physics of long kinematic chains runs up to a thousand times slower with them."""

_FIRST_JAXLIB_WITHOUT_FLAG = (0, 11, 1)
"""From this version on XLA ends the process if the flag is set, as with any unknown one."""


def flags_on_cpu(users_flags: str) -> str:
    """`XLA_FLAGS` for physics on a CPU: the user's, and what else this jaxlib needs."""
    # Read from the package's metadata: the controller must not import jax.
    jaxlib = numbers_of(versions_of(["jaxlib"])["jaxlib"])
    if () < jaxlib < _FIRST_JAXLIB_WITHOUT_FLAG and _FUSION_EMITTERS not in users_flags:
        return f"{users_flags} {_FUSION_EMITTERS}=false".strip()
    return users_flags


def pool_on_cpu(cores: int) -> int:
    """Threads of XLA's pool on so many cores.

    A pool of exactly two can hang on batched physics, so two and three cores get a larger one.
    """
    return 1 if cores == 1 else max(_SMALLEST_POOL, cores)


def missing_on_cpu(environment: Mapping[str, str], cores: int) -> dict[str, str]:
    """Variables that physics on a CPU needs, and that `environment` does not have so."""
    missing: dict[str, str] = {}
    users_flags = environment.get(XLA_FLAGS, "")
    if (flags := flags_on_cpu(users_flags)) != users_flags:
        missing[XLA_FLAGS] = flags
    if POOL not in environment and pool_on_cpu(cores) != cores:
        missing[POOL] = str(pool_on_cpu(cores))
    return missing
