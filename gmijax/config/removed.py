"""Keys of earlier versions, and what to write now. No hydra, no jax."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from gmijax.errors import ConfigError


class Removed(NamedTuple):
    """A key that was removed."""

    write: str  # What to write now.
    # Saved values with which a run goes on as it did; None: all of them.
    harmless: tuple[Any, ...] | None = None


REMOVED: Final[Mapping[str, Removed]] = MappingProxyType(
    {
        "reduce.selection": Removed(
            "in place of paper write reduce.strategy=paper; device is the default, and measured "
            "never took another strategy than it does",
            ("device",),
        ),
        "reduce.intra": Removed(
            "reduce.strategy=mpr keeps exchanges in memory of the host; har goes through that of "
            "the GPU where it can",
            ("auto",),
        ),
    }
)
"""By dotted name."""


def require_not_removed(key: str) -> None:
    """Raises ConfigError, with what to write now, for a key of an earlier version."""
    if key in REMOVED:
        raise ConfigError(f"{key}: removed; {REMOVED[key].write}")


def without_removed(saved: Mapping[str, Any]) -> dict[str, Any]:
    """A saved configuration without the removed keys whose value changes nothing."""
    kept: dict[str, Any] = {
        name: dict(value) if isinstance(value, Mapping) else value for name, value in saved.items()
    }
    for key, removed in REMOVED.items():
        group, _, name = key.rpartition(".")
        inner = kept.get(group)
        if not isinstance(inner, dict) or name not in inner:
            continue
        if removed.harmless is None or inner[name] in removed.harmless:
            del inner[name]
    return kept
