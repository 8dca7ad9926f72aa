"""The reduction strategies as stages, and what they should cost by the paper (section 4.1).

Which of them a layout gets (Algorithm 1) and which it allows: `gmijax.partition.reduction`.
No jax.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple, TypeAlias

from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import is_even, leaders

Kind: TypeAlias = Literal["all_reduce", "all_gather", "broadcast"]
TransportName: TypeAlias = Literal["host", "ipc", "ring", "nodes"]
"""Through shared memory of the host, memory of the GPUs that all map, NCCL between GPUs (of one
node or several), sockets between nodes and memory of the host in each."""

Groups: TypeAlias = tuple[tuple[int, ...], ...]
"""Ranks that exchange with each other; no rank is in two of them, some may be in none."""


class ReductionStage(NamedTuple):
    """One part of a reduction.

    Attributes:
      kind: all members of a group get their sum, or what each of them has, which the program
        sums in the order of the group, or what its first member has.
      transport: how the numbers move; ipc all-gathers and broadcasts only.
      groups: ranks; those that are in none keep what they have. Stages through ipc all have the
        same ones, with every rank in one of them. Between nodes these are the groups: what is
        summed is what their first ranks have, and all ranks get it.
    """

    kind: Kind
    transport: TransportName
    groups: Groups

    def reads(self, rank: int) -> bool:
        """Whether another rank gets what this rank has; else it only receives."""
        if self.kind == "broadcast" or self.transport == "nodes":
            return not any(rank in group[1:] for group in self.groups)
        return True


def stages(
    strategy: str, layout: Layout, intra: str = "host", inter: str | None = None
) -> Sequence[ReductionStage]:
    """What ranks do one after the other to have the sum over all of them, by strategy.

    - `mpr`, multi-process reduction: all through the host.
    - `flat`: one ring over all, plain data parallelism.
    - `mrr`, multi-ring reduction: one ring for every index on a GPU; then one member of each
      ring, each on another GPU, in a last ring; then back to the members of its first ring.
    - `har`, hierarchical reduction: inside every GPU, a ring between the GPUs, and back. Where
      each GPU has as many GMIs and all of them have their GPU's sum, there is a ring for every
      index, and no way back.
    - `one_shot`: every rank writes to every GPU, and sums what is there. Not in the paper. What
      travels is K - t buffers to each GPU, for a ring of K it would be two: it is made for
      networks whose messages cost more than their bytes.

    On several nodes each of them does that inside. Then by `tcp` their first ranks sum, and give
    it to the others of their nodes. By `nccl` rings go over all nodes: with one GMI on each GPU
    one ring is all there is; the last ring of `mrr` and the ring between the GPUs of `har` have
    members on all nodes; with `one_shot` the first ranks of the nodes form a ring.
    With `mpr` nodes sum by TCP all the same.

    Args:
      strategy: a key of `COSTS`.
      layout: where the ranks live; the strategy must be allowed there.
      intra: `host` or `ipc`, the transport inside a GPU for `har`.
      inter: `nccl` or `tcp`, between nodes; None: by TCP if there are several.
    """
    if layout.num_nodes > 1 and (inter != "nccl" or strategy == "mpr"):
        return _over_nodes(stages(strategy, layout.of_node(0), intra), layout.gmis_of_node)
    gpus = layout.gmis_of_gpu
    if strategy == "mpr":
        return [ReductionStage("all_reduce", "host", layout.gmis_of_node)]
    if strategy == "one_shot":
        return _one_shot(layout.gmis_of_node)
    if layout.num_gmis == layout.num_gpus and (strategy != "har" or layout.num_nodes > 1):
        return [ReductionStage("all_reduce", "ring", (tuple(itertools.chain(*gpus)),))]
    return _multi_ring(layout) if strategy == "mrr" else _hierarchical(layout, intra)


def inside_nodes(parts: Sequence[ReductionStage], layout: Layout) -> Sequence[ReductionStage]:
    """The stages before the first one that needs another node."""
    return list(itertools.takewhile(lambda stage: not _crosses_nodes(stage, layout), parts))


def values_after(parts: Sequence[ReductionStage], values: Sequence[int]) -> list[int]:
    """What ranks that begin with these numbers, by rank, have after these stages."""
    held = list(values)
    for stage in parts:
        if stage.transport == "nodes":
            held = [sum(held[group[0]] for group in stage.groups)] * len(held)
            continue
        for group in stage.groups:
            is_sum = stage.kind != "broadcast"
            result = sum(held[rank] for rank in group) if is_sum else held[group[0]]
            for rank in group:
                held[rank] = result
    return held


def _crosses_nodes(stage: ReductionStage, layout: Layout) -> bool:
    homes = ({layout.node_of(rank) for rank in group} for group in stage.groups)
    return stage.transport == "nodes" or any(len(nodes) > 1 for nodes in homes)


def _one_shot(nodes: Groups) -> Sequence[ReductionStage]:
    """One stage in each node, and if there are several a ring of their first ranks, and back."""
    inside = ReductionStage("all_gather", "ipc", nodes)
    if len(nodes) == 1:
        return [inside]
    between = ReductionStage("all_reduce", "ring", (tuple(node[0] for node in nodes),))
    if len(nodes[0]) == 1:
        return [between]
    return [inside, between, inside._replace(kind="broadcast")]


def _multi_ring(layout: Layout) -> Sequence[ReductionStage]:
    """`mrr` where GPUs have several GMIs: in each node a ring for every index on a GPU."""
    each = layout.num_gpus // layout.num_nodes
    rings: list[tuple[int, ...]] = []
    ends: list[int] = []
    for node in range(layout.num_nodes):
        here = zip(*layout.gmis_of_gpu[node * each : (node + 1) * each], strict=True)
        for index, ring in enumerate(here):
            # Ring k ends on GPU k: the ends are on different GPUs, as NCCL asks.
            rings.append(ring)
            ends.append(ring[index])
    back = tuple(_first(end, ring) for end, ring in zip(ends, rings, strict=True))
    return [
        ReductionStage("all_reduce", "ring", tuple(rings)),
        ReductionStage("all_reduce", "ring", (tuple(ends),)),
        ReductionStage("broadcast", "ring", back),
    ]


def _hierarchical(layout: Layout, intra: str) -> Sequence[ReductionStage]:
    """`har`."""
    gpus = layout.gmis_of_gpu
    inner: TransportName = "ipc" if intra == "ipc" else "host"
    led = tuple(_first(leader, gpu) for leader, gpu in zip(leaders(layout), gpus, strict=True))
    inside = ReductionStage("all_gather" if inner == "ipc" else "all_reduce", inner, led)
    if len(gpus) == 1:
        return [inside]
    # Between nodes a ring of all GMIs would send as many times as much.
    if inner == "ipc" and is_even(layout) and layout.num_nodes == 1:
        # Not a sum of NCCL's: its order may differ from ring to ring.
        return [inside, ReductionStage("all_gather", "ring", tuple(zip(*gpus, strict=True)))]
    between = ReductionStage("all_reduce", "ring", (leaders(layout),))
    return [inside, between, ReductionStage("broadcast", inner, led)]


def _over_nodes(inside: Sequence[ReductionStage], nodes: Groups) -> Sequence[ReductionStage]:
    """What one node does as done by all, and the sum over nodes by TCP."""
    if len(nodes[0]) == 1:
        inside = []
    everywhere = [
        stage._replace(
            groups=tuple(
                tuple(rank + node[0] for rank in group) for node in nodes for group in stage.groups
            )
        )
        for stage in inside
    ]
    return [*everywhere, ReductionStage("all_reduce", "nodes", nodes)]


def _first(leader: int, group: Sequence[int]) -> tuple[int, ...]:
    return (leader, *(rank for rank in group if rank != leader))


BYTES_PER_FLOAT = 4


COSTS: Mapping[str, Callable[[int, int, float, float, float], float]] = {
    "mpr": lambda g, t, m_p, b1, b2: 2 * (g * t - 1) * m_p / (g * t * b1),
    "mrr": lambda g, t, m_p, b1, b2: 2 * (g - 1) * (t + 1) * m_p / (g * b2),
    "har": lambda g, t, m_p, b1, b2: 2 * (g - 1) * m_p / (g * b2) + 2 * (t - 1) * m_p / (t * b1),
    # Not in the paper: its ring formula for g t members.
    "flat": lambda g, t, m_p, b1, b2: 2 * (g * t - 1) * m_p / (g * t * b2),
    # Not in the paper: what leaves a GPU. Memory of the own GPU is taken to cost nothing.
    "one_shot": lambda g, t, m_p, b1, b2: (g - 1) * t * m_p / b2,
}
"""Table 2: seconds of every strategy as a function of (g, t, M_p, B1, B2).

g GPUs with t GMIs each, M_p bytes; B1 and B2 are bytes a second, between GMIs through host memory
and of a ring between GPUs.
"""


def nodes_s(n: int, m_p: float, b3: float) -> float:
    """Seconds of the exchange between the leaders of n nodes: 2 (n - 1) M_p / (n B3).

    Not in the paper. Each sums its part of the buffer, and sends it to the others.
    """
    return 2 * (n - 1) * m_p / (n * b3)


def predicted_s(
    strategy: str,
    layout: Layout,
    num_floats: int,
    b1: float,
    b2: float,
    b3: float | None = None,
) -> float:
    """Seconds that one mean of `num_floats` float32 should take.

    In an uneven layout t is the number of GMIs on the fullest GPU: the others wait for it. On
    several nodes it is the time inside one of them and that between them.

    Args:
      strategy: a key of `COSTS`.
      layout: where the GMIs live.
      num_floats: P.
      b1: bytes a second between GMIs through host memory.
      b2: bytes a second of a ring between GPUs.
      b3: bytes a second between nodes; needed where there are several.

    Raises:
      ConfigError: a bandwidth that is not positive.
    """
    if min(known := [b for b in (b1, b2, b3) if b is not None]) <= 0:
        raise ConfigError(f"bandwidths {known}: must be positive")
    m_p, node = num_floats * BYTES_PER_FLOAT, layout.of_node(0)
    most = max(len(gmis) for gmis in node.gmis_of_gpu)
    inside_s = COSTS[strategy](node.num_gpus, most, m_p, b1, b2)
    if layout.num_nodes == 1:
        return inside_s
    assert b3 is not None
    return inside_s + nodes_s(layout.num_nodes, m_p, b3)
