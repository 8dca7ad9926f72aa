"""Keys of earlier versions, and what to write now. No hydra, no jax."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from gmijax.errors import ConfigError


class Removed(NamedTuple):
    """A key that was removed.

    Attributes:
      write: what to write now.
      harmless: saved values with which a run continues as before; None: all of them.
    """

    write: str
    harmless: tuple[Any, ...] | None = None


REMOVED: Final[Mapping[str, Removed]] = MappingProxyType(
    {
        "reduce.selection": Removed(
            "instead of paper write reduce.strategy=paper; device is the default, and measured "
            "never took another strategy than it does",
            ("device",),
        ),
        "reduce.intra": Removed(
            "reduce.strategy=mpr keeps exchanges in memory of the host; har goes through that of "
            "the GPU where it can",
            ("auto",),
        ),
        "channel.transfer_kib": Removed(
            "the size of transfers is found by trying",
            (None,),
        ),
        "plan.mps_priority": Removed(
            "all GMIs of a GPU have the same priority, as was the default",
        ),
        "plan.force_sm_percent": Removed(
            "give plan.sm_percent one of the values that docs/shares.md calls clean",
        ),
        "search.mode": Removed(
            "every profile runs all GMIs of a GPU at once, as corun did",
        ),
        "search.alpha": Removed("a row of sizes ends at 0.1, as was the default"),
        "search.tolerance": Removed("differences of 2 % are ignored, as was the default"),
        "search.iterations": Removed("a profile has 6 iterations, as was the default"),
        "search.profile_timeout_s": Removed(
            "a profile may take half of search.budget_s; write twice the value there",
        ),
        "search.training_gmis_per_gpu": Removed(
            "training GMIs are as many as plan.training_gmis_per_gpu says; search for each number",
        ),
        "run.exchange_timeout_s": Removed(
            "a GMI that serves waits for another for 120 s, or for run.stall_timeout_s if that "
            "is less",
        ),
        "output.compress": Removed("compress the shards afterwards"),
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
