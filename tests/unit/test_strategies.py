"""What ranks do one after the other, by strategy and layout."""

from __future__ import annotations

import pytest

from gmijax.collectives.strategies import Stage, stages
from gmijax.partition.layout import Layout

ALL = ((0, 1, 2, 3),)
GPUS, RINGS = ((0, 1), (2, 3)), ((0, 2), (1, 3))


@pytest.mark.parametrize(
    ("strategy", "intra", "layout", "expected"),
    [
        ("mpr", "host", GPUS, [Stage("sum", "host", ALL)]),
        ("one_shot", "ipc", GPUS, [Stage("gather", "slots", ALL)]),
        ("flat", "host", ((0,), (1,)), [Stage("sum", "ring", ((0, 1),))]),
        ("mrr", "host", ((0,), (1,)), [Stage("sum", "ring", ((0, 1),))]),
        (
            *("mrr", "host", GPUS),
            [
                Stage("sum", "ring", RINGS),
                Stage("sum", "ring", ((0, 3),)),
                Stage("broadcast", "ring", ((0, 2), (3, 1))),
            ],
        ),
        ("har", "host", ALL, [Stage("sum", "host", ALL)]),
        ("har", "ipc", ALL, [Stage("gather", "slots", ALL)]),
        ("har", "ipc", GPUS, [Stage("gather", "slots", GPUS), Stage("gather", "ring", RINGS)]),
        (
            *("har", "host", GPUS),
            [
                Stage("sum", "host", GPUS),
                Stage("sum", "ring", ((0, 2),)),
                Stage("broadcast", "host", GPUS),
            ],
        ),
        (
            *("har", "ipc", ((0, 1), (2,))),
            [
                Stage("gather", "slots", ((0, 1), (2,))),
                Stage("sum", "ring", ((0, 2),)),
                Stage("broadcast", "slots", ((0, 1), (2,))),
            ],
        ),
    ],
)
def test_the_stages_by_hand(
    strategy: str, intra: str, layout: tuple[tuple[int, ...], ...], expected: list[Stage]
) -> None:
    assert list(stages(strategy, Layout(layout), intra)) == expected
