"""Which reduction strategies a layout allows, and which one it gets: rules, no jax.

The controller checks a plan with them before it starts anything, and
`gmijax.collectives.communicator` refuses by the same rules in a GMI.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout
from gmijax.version import numbers_of, versions_of

_BINDINGS = "cuda-bindings"
LEAST_BINDINGS = (12, 9, 1)
"""Of CUDA 12; earlier ones hold the GIL in calls that wait in CUDA for other GMIs, so that the
thread that looks whether these live cannot run."""

_INSTALL = "(pip install 'gmijax[cuda13]', with a driver before 580 'gmijax[cuda12]')"


class Choice(NamedTuple):
    """A strategy and why it was chosen, in words."""

    strategy: str
    why: str


def select_strategy(layout: Layout) -> Choice:
    """Algorithm 1 of the paper (section 4.1), exactly as printed.

    It looks at the layout alone: how many GPUs, and how many GMIs each of them has. On several
    nodes, of which the paper does not speak, it is the answer for one of them.
    """
    if layout.num_nodes > 1:
        inside = select_strategy(layout.of_node(0))
        return inside._replace(why=f"in every node {inside.why}")
    num_gpus = layout.num_gpus
    if num_gpus <= 1:
        return Choice("mpr", "all GMIs are on one GPU, so they average in host memory")
    gmis_per_gpu = {len(gmis) for gmis in layout.gmis_of_gpu}
    if len(gmis_per_gpu) > 1:
        return Choice(
            "har", "GPUs have different numbers of GMIs, so each GPU sends a leader to one ring"
        )
    per_gpu = gmis_per_gpu.pop()
    if per_gpu > num_gpus:
        return Choice(
            "har",
            f"{per_gpu} GMIs on each of only {num_gpus} GPUs, so each GPU sends a leader to one "
            "ring",
        )
    return Choice(
        "mrr",
        f"{per_gpu} GMIs on each of {num_gpus} GPUs, so as many rings that share no GMI",
    )


def why_not_strategy(strategy: str, layout: Layout) -> str | None:
    """None if `strategy` can run on `layout`, else the reason in words."""
    if layout.num_nodes == 1 or strategy in ("none", "flat"):
        return STRATEGIES[strategy].why_not(layout)  # One ring may go over all nodes.
    # It is what each node does inside; `inter` is how nodes exchange, whatever that is.
    reason = STRATEGIES[strategy].why_not(layout.of_node(0))
    return reason and f"in each node {reason}"


def why_not_intra(intra: str, backend: str) -> str | None:
    """None if `intra` can move numbers inside one GPU under `backend`, else the reason."""
    if intra == "host":
        return None
    if backend == "cpu":
        return (
            "CUDA IPC needs an NVIDIA GPU whose GMIs share it by mps or share; the backend is cpu"
        )
    if backend == "mig":
        return "there is no CUDA IPC between the instances of a GPU in MIG mode"
    return why_no_bindings()


def require_strategy(strategy: str, layout: Layout, backend: str | None = None) -> None:
    """Raises ConfigError with strategy, layout and reason if they do not go together."""
    if strategy not in STRATEGIES:
        raise ConfigError(f"reduce.strategy={strategy}: expected one of {', '.join(STRATEGIES)}")
    reason = why_not_strategy(strategy, layout)
    if reason is None and backend is not None:
        reason = why_not_under(strategy, layout, backend)
    if reason is not None:
        raise ConfigError(f"reduce.strategy={strategy}: cannot run on layout {layout}: {reason}")


def why_not_under(strategy: str, layout: Layout, backend: str) -> str | None:
    """None if `backend` gives `strategy` what it needs on `layout`, else the reason in words."""
    if strategy == "one_shot":
        return why_not_intra("ipc", backend)
    if backend == "cpu" or not needs_ring(strategy, layout):
        return None
    if backend == "mig":
        return (
            "rings between MIG instances are not supported, because NCCL takes one of each GPU; "
            "with plan.backend=mig only auto, mpr are allowed"
        )
    return why_no_nccl()


def why_no_bindings() -> str | None:
    """None if a program can hand numbers to other processes from a GPU, else the reason."""
    if not is_installed("cuda", "cuda.bindings"):
        return f"exchanges between GMIs on GPUs need the package cuda-bindings {_INSTALL}"
    installed = versions_of([_BINDINGS])[_BINDINGS]
    numbers = numbers_of(installed)
    if not numbers or numbers >= LEAST_BINDINGS:
        return None
    least = ".".join(map(str, LEAST_BINDINGS))
    return (
        f"exchanges between GMIs on GPUs need cuda-bindings {least} or newer, and {installed} is "
        f"installed (pip install 'cuda-bindings>={least},<13' with CUDA 12, "
        "'cuda-bindings>=13' with 13)"
    )


def why_not_nccl(layout: Layout, backend: str, devices: Sequence[str]) -> str | None:
    """None if nodes can exchange by NCCL, else the reason.

    Args:
      layout: of the GMIs that train.
      backend: of all nodes.
      devices: what each of them sees, by rank: UUIDs of GPUs.
    """
    if backend in ("cpu", "mig"):
        return f"NCCL needs whole GPUs, and the backend is {backend}"
    homes = {(device, layout.node_of(rank)) for rank, device in enumerate(devices)}
    if len(homes) > len(set(devices)):
        return "nodes of one machine have the same GPU, and NCCL takes one process of each"
    return why_no_nccl() or why_no_bindings()


def why_no_nccl() -> str | None:
    """None if GPUs can form rings, else the reason."""
    if is_installed("nccl", "nccl.bindings"):
        return None
    return f"rings between GPUs need the package nccl4py {_INSTALL}"


def needs_ring(strategy: str, layout: Layout) -> bool:
    """Whether GMIs form rings between the GPUs of a node."""
    return STRATEGIES[strategy].has_ring(layout.of_node(0))


def is_one_per_gpu(layout: Layout) -> bool:
    """Whether one GMI on each of several GPUs trains: a ring over all is the whole exchange."""
    inside = layout.of_node(0)
    return inside.num_gpus > 1 and inside.num_gmis == inside.num_gpus


def leaders(layout: Layout) -> tuple[int, ...]:
    """The GMI of every GPU that speaks for it in HAR.

    The paper's rule is `id % M == t` with M GMIs on every GPU; t is 0 here. Where it does not
    give every GPU exactly one leader (uneven layouts, ids in another order), the smallest id of
    each GPU leads.
    """
    most = max(len(gmis) for gmis in layout.gmis_of_gpu)
    found = [[gmi for gmi in gmis if gmi % most == 0] for gmis in layout.gmis_of_gpu]
    if all(len(gmis) == 1 for gmis in found):
        return tuple(gmis[0] for gmis in found)
    return tuple(min(gmis) for gmis in layout.gmis_of_gpu)


def is_even(layout: Layout) -> bool:
    """Whether every GPU has as many GMIs as the others."""
    return len({len(gmis) for gmis in layout.gmis_of_gpu}) == 1


def is_installed(*modules: str) -> bool:
    """Whether all modules can be imported; the packages of each come before it."""
    return all(importlib.util.find_spec(module) is not None for module in modules)


def _none(layout: Layout) -> str | None:
    if layout.num_gmis == 1:
        return None
    return f"only for a job with one GMI, this one has {layout.num_gmis}"


def _anywhere(layout: Layout) -> str | None:
    del layout  # Memory is there whatever the GPUs are.
    return None


def _mrr(layout: Layout) -> str | None:
    sizes = [len(gmis) for gmis in layout.gmis_of_gpu]
    if layout.num_gpus < 2:
        return "its rings go from GPU to GPU, and there is only one"
    if len(set(sizes)) > 1:
        return f"every ring takes one GMI of each GPU, and the GPUs have {sizes} GMIs"
    if sizes[0] > layout.num_gpus:
        return (
            f"the last ring takes one GMI of each of the {sizes[0]} first rings, each on another "
            f"GPU, and there are only {layout.num_gpus}"
        )
    return None


def _flat(layout: Layout) -> str | None:
    sizes = [len(gmis) for gmis in layout.gmis_of_gpu]
    if max(sizes) > 1:
        return (
            f"one communicator over all GMIs, and the GPUs have {sizes}: NCCL before 2.30 takes "
            "one process of a GPU, and later versions are not supported yet"
        )
    if layout.num_gpus < 2:
        return "its ring goes from GPU to GPU, and there is only one"
    return None


class Strategy(NamedTuple):
    """Rules of a reduction strategy.

    Attributes:
      why_not: None if it can run on a layout, else the reason in words.
      has_ring: whether it forms rings of NCCL between GPUs.
      ways: how GMIs of one GPU may exchange; `host` for those that do not care.
    """

    why_not: Callable[[Layout], str | None]
    has_ring: Callable[[Layout], bool] = lambda _: False
    ways: tuple[str, ...] = ("host",)


STRATEGIES: Mapping[str, Strategy] = MappingProxyType(
    {
        "none": Strategy(_none),
        "mpr": Strategy(_anywhere),
        "mrr": Strategy(_mrr, lambda _: True),
        "har": Strategy(_anywhere, lambda layout: layout.num_gpus > 1, ("host", "ipc")),
        "flat": Strategy(_flat, lambda _: True),
        "one_shot": Strategy(_anywhere, ways=("ipc",)),
    }
)
"""The strategies by name. What their ranks do: `gmijax.collectives.strategies.stages`."""
