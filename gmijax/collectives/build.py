"""The reduction strategies by name; a new one is one file and one entry here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from gmijax.collectives.interface import Reducer
from gmijax.collectives.mpr import MprReducer
from gmijax.collectives.solo import SoloReducer
from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout


@dataclass(frozen=True, kw_only=True)
class Membership:
    """What a strategy must know to build the reducer of one rank.

    Attributes:
      layout: where all ranks live; the rank of a GMI is its id.
      rank: this GMI's.
      num_floats: P, length of the buffers for `mean`.
      exchange_fd: descriptor of the shared block, None where no strategy needs it.
      timeout_s: longest wait for other ranks.
      rendezvous_timeout_s: the same in the first call, when others may still start or compile.
    """

    layout: Layout
    rank: int
    num_floats: int
    exchange_fd: int | None
    timeout_s: float
    rendezvous_timeout_s: float


class Strategy(NamedTuple):
    """One way to reduce.

    Attributes:
      why_not: None if the strategy works for a layout, else the reason in words.
      build: makes the reducer of one rank.
    """

    why_not: Callable[[Layout], str | None]
    build: Callable[[Membership], Reducer]


def build_reducer(name: str, membership: Membership) -> Reducer:
    """Makes the reducer of one rank with the strategy `name`.

    Raises:
      ConfigError: no such strategy, or it does not work for this layout.
      CollectiveError: the shared memory cannot be had.
    """
    if name not in STRATEGIES:
        raise ConfigError(f"reduce.strategy={name}: expected one of {', '.join(STRATEGIES)}")
    strategy = STRATEGIES[name]
    if reason := strategy.why_not(membership.layout):
        raise ConfigError(f"reduce.strategy={name}: {reason}")
    return strategy.build(membership)


def _why_not_solo(layout: Layout) -> str | None:
    if layout.num_gmis == 1:
        return None
    return f"only for a job with one GMI, this one has {layout.num_gmis}"


def _build_solo(membership: Membership) -> Reducer:
    return SoloReducer(membership.num_floats)


def _why_not_mpr(layout: Layout) -> str | None:
    del layout  # host memory is there whatever the GPUs are
    return None


def _build_mpr(membership: Membership) -> Reducer:
    if membership.exchange_fd is None:
        raise ConfigError("reduce.strategy=mpr: needs the shared block of the job's controller")
    return MprReducer(
        membership.exchange_fd,
        membership.rank,
        membership.layout.num_gmis,
        membership.num_floats,
        timeout_s=membership.timeout_s,
        rendezvous_timeout_s=membership.rendezvous_timeout_s,
    )


STRATEGIES: Mapping[str, Strategy] = {
    "none": Strategy(why_not=_why_not_solo, build=_build_solo),
    "mpr": Strategy(why_not=_why_not_mpr, build=_build_mpr),
}
"""Every strategy; `none` is what a plan with a single GMI uses."""
