"""How environments per GMI and GMIs per GPU are found where they are `auto`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError

AUTO = "auto"
"""The value of `num_envs` and `plan.gmis_per_gpu` that the search is to find."""

SHORTEST_BUDGET_S = 10.0
"""No GMI starts, compiles and trains in less."""


@dataclass(frozen=True, kw_only=True)
class SearchConfig(KeyGroup):
    """The search of `gmijax.search`, and of `num_envs=auto plan.gmis_per_gpu=auto`."""

    prefix = "search."

    gmis_per_gpu: tuple[int, ...] = doc("numbers of GMIs per GPU to choose from", low=1)
    training_gmis_per_gpu: tuple[int, ...] = doc(
        "with algo=a3c: numbers of training GMIs to choose from, on every GPU that trains; "
        "gmis_per_gpu are those that act",
        default=(1,),
        low=1,
    )
    num_envs: tuple[int, ...] = doc("environments per GMI to choose from", low=1)
    impls: tuple[str, ...] = doc(
        "MJX implementations to choose from, e.g. [jax,warp]; []: the one of physics.impl"
    )
    mode: Literal["corun", "isolated", "both"] = doc(
        "profile all GMIs of a GPU at once, or one alone with its share (as the paper prints); "
        "both: choose by corun, then profile the same points isolated and report the ratio"
    )
    order: Literal["coarse_first", "as_printed"] = doc(
        "every third row with the largest size and the third below it, then the neighbours of the "
        "best point; or the whole grid in the order of the paper's Algorithm 2"
    )
    alpha: float = doc(
        "a row of sizes ends when gain of throughput / growth of memory is below this",
        low=0.0,
    )
    tolerance: float = doc("relative difference of throughput that is ignored", low=0.0, high=0.5)
    iterations: int = doc(
        "training iterations of one profile, the first is not counted; with algo=a3c batches that "
        "are counted, at least",
        low=2,
    )
    budget_s: float = doc("seconds for the whole search; the best point so far is the answer")
    profile_timeout_s: float = doc("a profile that takes longer is not runnable, seconds", low=1.0)
    store: str | None = doc(
        "folder of the profiles of earlier searches; null: gmijax/profiles in the user's cache"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("gmis_per_gpu", "training_gmis_per_gpu", "num_envs"):
            values = getattr(self, key)
            if not values or len(set(values)) != len(values):
                raise ConfigError(f"search.{key}={list(values)}: expected distinct numbers")
        if bad := [impl for impl in self.impls if impl not in ("jax", "warp")]:
            raise ConfigError(f"search.impls={bad[0]}: allowed are jax, warp")
        if len(set(self.impls)) != len(self.impls):
            raise ConfigError(f"search.impls={list(self.impls)}: expected distinct names")
        if not self.budget_s >= SHORTEST_BUDGET_S:  # Not a number is refused too.
            raise ConfigError(
                f"search.budget_s={self.budget_s:g}: too small for one profile; must be at least "
                f"{SHORTEST_BUDGET_S:g}"
            )
