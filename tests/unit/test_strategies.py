"""What ranks do one after the other, by strategy and layout."""

from __future__ import annotations

import pytest

from gmijax.collectives.strategies import (
    COSTS,
    ReductionStage,
    inside_nodes,
    stages,
    values_after,
)
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import why_not_strategy

ALL = ((0, 1, 2, 3),)
GPUS, RINGS = ((0, 1), (2, 3)), ((0, 2), (1, 3))


@pytest.mark.parametrize(
    ("strategy", "intra", "layout", "expected"),
    [
        ("mpr", "host", GPUS, [ReductionStage("all_reduce", "host", ALL)]),
        ("one_shot", "ipc", GPUS, [ReductionStage("all_gather", "ipc", ALL)]),
        ("flat", "host", ((0,), (1,)), [ReductionStage("all_reduce", "ring", ((0, 1),))]),
        ("mrr", "host", ((0,), (1,)), [ReductionStage("all_reduce", "ring", ((0, 1),))]),
        (
            *("mrr", "host", GPUS),
            [
                ReductionStage("all_reduce", "ring", RINGS),
                ReductionStage("all_reduce", "ring", ((0, 3),)),
                ReductionStage("broadcast", "ring", ((0, 2), (3, 1))),
            ],
        ),
        ("har", "host", ALL, [ReductionStage("all_reduce", "host", ALL)]),
        ("har", "ipc", ALL, [ReductionStage("all_gather", "ipc", ALL)]),
        (
            "har",
            "ipc",
            GPUS,
            [
                ReductionStage("all_gather", "ipc", GPUS),
                ReductionStage("all_gather", "ring", RINGS),
            ],
        ),
        (
            *("har", "host", GPUS),
            [
                ReductionStage("all_reduce", "host", GPUS),
                ReductionStage("all_reduce", "ring", ((0, 2),)),
                ReductionStage("broadcast", "host", GPUS),
            ],
        ),
        (
            *("har", "ipc", ((0, 1), (2,))),
            [
                ReductionStage("all_gather", "ipc", ((0, 1), (2,))),
                ReductionStage("all_reduce", "ring", ((0, 2),)),
                ReductionStage("broadcast", "ipc", ((0, 1), (2,))),
            ],
        ),
    ],
)
def test_the_stages_by_hand(
    strategy: str, intra: str, layout: tuple[tuple[int, ...], ...], expected: list[ReductionStage]
) -> None:
    assert list(stages(strategy, Layout(layout), intra)) == expected


@pytest.mark.parametrize(
    ("strategy", "intra", "layout", "expected"),
    [
        ("flat", "host", ((0,), (1,)), [ReductionStage("all_reduce", "ring", ((0, 1),))]),
        ("mrr", "host", ((0,), (1,), (2,), (3,)), [ReductionStage("all_reduce", "ring", ALL)]),
        ("har", "ipc", ((0,), (1,)), [ReductionStage("all_reduce", "ring", ((0, 1),))]),
        (
            *("one_shot", "ipc", GPUS),
            [
                ReductionStage("all_gather", "ipc", GPUS),
                ReductionStage("all_reduce", "ring", ((0, 2),)),
                ReductionStage("broadcast", "ipc", GPUS),
            ],
        ),
        (
            *("har", "ipc", GPUS),
            [
                ReductionStage("all_gather", "ipc", GPUS),
                ReductionStage("all_reduce", "ring", ((0, 2),)),
                ReductionStage("broadcast", "ipc", GPUS),
            ],
        ),
        (
            *("mrr", "host", ((0, 1), (2, 3), (4, 5), (6, 7))),
            [
                ReductionStage("all_reduce", "ring", ((0, 2), (1, 3), (4, 6), (5, 7))),
                ReductionStage("all_reduce", "ring", ((0, 3, 4, 7),)),
                ReductionStage("broadcast", "ring", ((0, 2), (3, 1), (4, 6), (7, 5))),
            ],
        ),
    ],
)
def test_rings_over_two_nodes_by_hand(
    strategy: str, intra: str, layout: tuple[tuple[int, ...], ...], expected: list[ReductionStage]
) -> None:
    assert list(stages(strategy, Layout(layout, 2), intra, "nccl")) == expected


LAYOUTS = [
    Layout(rows).on_nodes(num_nodes)
    for rows in (((0,),), ((0, 1),), ((0,), (1,)), GPUS, ((0, 1), (2,)), ((0, 2), (1, 3)))
    for num_nodes in (1, 2, 3)
]


@pytest.mark.parametrize("inter", ["nccl", "tcp"])
@pytest.mark.parametrize("intra", ["host", "ipc"])
@pytest.mark.parametrize("strategy", COSTS)
def test_all_ranks_have_the_sum_after_all_stages(strategy: str, intra: str, inter: str) -> None:
    allowed = [one for one in LAYOUTS if why_not_strategy(strategy, one) is None]
    assert any(layout.num_nodes > 1 for layout in allowed)
    for layout in allowed:
        values = [10**rank for rank in layout.gmis]
        parts = stages(strategy, layout, intra, inter)
        assert values_after(parts, values) == [sum(values)] * len(values), layout
        gpus = [
            [layout.gpu_of(rank) for rank in group]
            for stage in parts
            if stage.transport == "ring"
            for group in stage.groups
        ]
        # NCCL takes one rank of each GPU, and what GPUs map is memory of one node.
        assert all(len(set(of_ring)) == len(of_ring) for of_ring in gpus), layout
        inside = inside_nodes(parts, layout)
        assert all(stage.transport != "nodes" for stage in inside)
        if layout.num_nodes == 1:
            assert inside == list(parts)
        for stage in parts:
            homes = [{layout.node_of(rank) for rank in group} for group in stage.groups]
            assert all(len(nodes) == 1 for nodes in homes) or stage.transport == "ring"
            assert stage not in inside or all(len(nodes) == 1 for nodes in homes)
