"""Settings of jax in the environment with which our programs do not work.

A user sets them for other programs, and every child would inherit them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

_OFF: Final = ("", "0", "f", "false", "n", "no", "off")
_GUARDS: Final = ("allow", "log", "log_explicit")

_HARMLESS: Final[Mapping[str, tuple[str, ...]]] = {
    "JAX_ENABLE_X64": _OFF,
    "JAX_DISABLE_JIT": _OFF,
    "JAX_NUMPY_DTYPE_PROMOTION": ("standard",),
    "JAX_NUMPY_RANK_PROMOTION": ("allow", "warn"),
    "JAX_PLATFORM_NAME": ("",),  # An older name of JAX_PLATFORMS, which is set for each child.
    "JAX_TRANSFER_GUARD": _GUARDS,
    "JAX_TRANSFER_GUARD_HOST_TO_DEVICE": _GUARDS,
    "JAX_TRANSFER_GUARD_DEVICE_TO_DEVICE": _GUARDS,
    "JAX_TRANSFER_GUARD_DEVICE_TO_HOST": _GUARDS,
}
"""Name -> the values that do no harm."""


def breaking(variables: Mapping[str, str]) -> dict[str, str]:
    """Those of the variables with which MJX, policies or the training do not work."""
    return {
        name: variables[name]
        for name, harmless in _HARMLESS.items()
        if name in variables and variables[name].lower() not in harmless
    }


def without_breaking(variables: Mapping[str, str]) -> dict[str, str]:
    """The variables for a child that uses jax."""
    dropped = breaking(variables)
    return {name: value for name, value in variables.items() if name not in dropped}
