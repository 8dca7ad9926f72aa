"""How environments per GMI and GMIs per GPU are found where they are `auto`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError

AUTO = "auto"
"""The value of `num_envs` and `plan.gmis_per_gpu` that the search is to find."""

PROFILED_ITERATIONS = 6
"""Of one profile, the first is not counted; with algo=a3c batches that are counted, at least."""

SHORTEST_BUDGET_S = 10.0
"""No GMI starts, compiles and trains in less."""


@dataclass(frozen=True, kw_only=True)
class SearchConfig(KeyGroup):
    """The search of `gmijax.search`, and of `num_envs=auto plan.gmis_per_gpu=auto`."""

    prefix = "search."

    gmis_per_gpu: tuple[int, ...] = doc(
        "numbers of GMIs per GPU to choose from; with algo=a3c of those that act", low=1
    )
    num_envs: tuple[int, ...] = doc("environments per GMI to choose from", low=1)
    impls: tuple[str, ...] = doc(
        "MJX implementations to choose from, e.g. [jax,warp]; []: the one of physics.impl"
    )
    order: Literal["coarse_first", "as_printed"] = doc(
        "every third row with the largest size and the third below it, then the neighbours of the "
        "best point; or the paper's Algorithm 2 as it is printed, over the whole grid"
    )
    budget_s: float = doc(
        "seconds for the whole search; the best point so far is the answer; a profile that takes "
        "longer than half of it is not runnable"
    )
    store: str | None = doc(
        "folder of the profiles of earlier searches; null: gmijax/profiles in the user's cache"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("gmis_per_gpu", "num_envs"):
            values = getattr(self, key)
            if not values:
                raise ConfigError(f"search.{key}=[]: expected at least one number")
            if len(set(values)) != len(values):
                raise ConfigError(f"search.{key}={list(values)}: expected distinct numbers")
        if bad := [impl for impl in self.impls if impl not in ("jax", "warp")]:
            raise ConfigError(f"search.impls={bad[0]}: expected one of jax, warp")
        if len(set(self.impls)) != len(self.impls):
            raise ConfigError(f"search.impls={list(self.impls)}: expected distinct names")
        if not self.budget_s >= SHORTEST_BUDGET_S:  # Not a number is refused too.
            raise ConfigError(
                f"search.budget_s={self.budget_s:g}: too small for one profile; must be at least "
                f"{SHORTEST_BUDGET_S:g}"
            )

    @property
    def profile_limit_s(self) -> float:
        """Seconds after which a profile is ended, and its point is not runnable."""
        return self.budget_s / 2
