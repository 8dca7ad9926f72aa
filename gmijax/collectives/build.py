"""The reduction strategies by name; a new one is one file and one entry here."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gmijax.collectives.device_memory import NewMemory, cuda_memory
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import Reducer
from gmijax.collectives.intra import INTRA, IntraExchange
from gmijax.collectives.mpr import MprReducer
from gmijax.collectives.solo import SoloReducer
from gmijax.errors import ConfigError, DeviceMemoryUnavailable
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import needs_ring, require_strategy

if TYPE_CHECKING:
    from gmijax.collectives.ring import World


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
      world: this process among those of all GMIs, None where no strategy needs rings.
      intra: how the GMIs of one GPU exchange numbers in HAR.
      host_if_unavailable: whether HAR goes through host memory, with a warning, where `intra`
        turns out not to work, and MPR takes the place of one_shot where that does not.
    """

    layout: Layout
    rank: int
    num_floats: int
    exchange_fd: int | None
    timeout_s: float
    rendezvous_timeout_s: float
    world: World | None = None
    intra: str = "host"
    host_if_unavailable: bool = False


def join_world(
    strategy: str, layout: Layout, rank: int, address: str | None, timeout_s: float
) -> World | None:
    """This process among those of all GMIs; None if the strategy needs no rings.

    Comes before all other use of jax.

    Raises:
      ConfigError: no address where the GMIs meet.
      CollectiveError: the others did not come.
    """
    if not needs_ring(strategy, layout):
        return None
    if address is None:
        raise ConfigError(f"reduce.strategy={strategy}: needs an address where GMIs meet")
    from gmijax.collectives.ring import World  # Imports jax.

    return World.join(layout, rank, address, timeout_s)


def build_reducer(name: str, membership: Membership) -> Reducer:
    """Makes the reducer of one rank with the strategy `name`.

    Those that leave host memory wait here until all ranks have come.

    Raises:
      ConfigError: no such strategy, or it does not work for this layout, or lacks something.
      CollectiveError: the shared memory cannot be had, or another rank is gone or does not come.
    """
    require_strategy(name, membership.layout)
    return STRATEGIES[name](membership)


def _none(membership: Membership) -> Reducer:
    return SoloReducer(membership.num_floats)


def _mpr(membership: Membership) -> Reducer:
    return MprReducer(_host("mpr", membership), membership.num_floats)


def _mrr(membership: Membership) -> Reducer:
    return _rings("mrr", membership)


def _flat(membership: Membership) -> Reducer:
    return _rings("flat", membership)


def _rings(name: str, membership: Membership) -> Reducer:
    from gmijax.collectives.mrr import RingReducer  # Imports jax.

    world = _world(name, membership)
    return RingReducer(_host(name, membership), world, membership.num_floats)


def _har(membership: Membership) -> Reducer:
    from gmijax.collectives.har import DeviceHarReducer, HarReducer  # Imports jax.
    from gmijax.collectives.ipc import IpcIntra

    layout, num_floats = membership.layout, membership.num_floats
    world = _world("har", membership) if needs_ring("har", layout) else None
    if membership.intra not in INTRA:
        raise ConfigError(f"reduce.intra={membership.intra}: expected one of {', '.join(INTRA)}")
    host = _host("har", membership)
    intra = _intra(membership, host)
    if isinstance(intra, IpcIntra):
        return DeviceHarReducer(host, intra, world, num_floats)
    return HarReducer(host, intra, world, num_floats)


def _one_shot(membership: Membership) -> Reducer:
    from gmijax.collectives.one_shot import OneShotReducer  # Imports jax.

    num_floats, host = membership.num_floats, _host("one_shot", membership)
    try:
        return OneShotReducer(host, membership.layout, num_floats, DEVICE_MEMORY)
    except DeviceMemoryUnavailable as error:
        if not membership.host_if_unavailable:
            host.close()
            raise
        warnings.warn(f"{error}; so reduce.strategy=mpr", RuntimeWarning, stacklevel=2)
        return MprReducer(host, num_floats)
    except BaseException:
        host.close()
        raise


def _intra(membership: Membership, host: HostExchange) -> IntraExchange:
    layout, rank, num_floats = membership.layout, membership.rank, membership.num_floats
    try:
        return INTRA[membership.intra](layout, rank, num_floats, host)
    except DeviceMemoryUnavailable as error:
        if not membership.host_if_unavailable:
            raise
        warnings.warn(f"{error}; so through host memory", RuntimeWarning, stacklevel=2)
    return INTRA["host"](layout, rank, num_floats, host)


def _host(name: str, membership: Membership) -> HostExchange:
    if membership.exchange_fd is None:
        raise ConfigError(
            f"reduce.strategy={name}: needs the shared block of the job's controller"
        )
    return HostExchange(
        membership.exchange_fd,
        membership.rank,
        membership.layout.num_gmis,
        membership.num_floats,
        timeout_s=membership.timeout_s,
        rendezvous_timeout_s=membership.rendezvous_timeout_s,
    )


def _world(name: str, membership: Membership) -> World:
    if membership.world is None:
        raise ConfigError(f"reduce.strategy={name}: needs a jax world of all GMIs; see World.join")
    return membership.world


DEVICE_MEMORY: NewMemory = cuda_memory
"""Makes the memory of GPUs that ranks share in `one_shot`."""

STRATEGIES: Mapping[str, Callable[[Membership], Reducer]] = {
    "none": _none,
    "mpr": _mpr,
    "mrr": _mrr,
    "har": _har,
    "flat": _flat,
    "one_shot": _one_shot,
}
"""How the reducer of one rank is made; `none` is what a plan with a single GMI uses.

Which layouts each of them takes: `gmijax.partition.reduction`.
"""
