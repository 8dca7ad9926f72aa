"""What ranks do one after the other, by strategy and layout."""

from __future__ import annotations

import pytest

from gmijax.collectives.strategies import ReductionStage, stages
from gmijax.partition.layout import Layout

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
