"""Strategies by name."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.collectives.communicator import SingleRankCommunicator
from gmijax.collectives.interface import Collectives
from gmijax.collectives.strategies import COSTS
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import why_not_strategy
from gmijax.types import Array


@pytest.mark.parametrize(
    ("layout", "usable"),
    [
        (Layout.even(1, 1), {"none", "mpr", "har", "one_shot"}),
        (Layout.even(1, 2), {"mpr", "har", "one_shot"}),
        (Layout.even(2, 1), {"mpr", "mrr", "har", "flat", "one_shot"}),
        (Layout.even(2, 2), {"mpr", "mrr", "har", "one_shot"}),
        (Layout.even(2, 3), {"mpr", "har", "one_shot"}),
        (Layout(((0, 1), (2,))), {"mpr", "har", "one_shot"}),
    ],
)
def test_which_strategies_a_layout_allows(layout: Layout, usable: set[str]) -> None:
    assert {name for name in ("none", *COSTS) if not why_not_strategy(name, layout)} == usable


def test_one_gmi_keeps_its_own_numbers() -> None:
    comm = SingleRankCommunicator()
    values = np.array([1.0, np.nan, -0.0, np.inf], np.float32)

    def step(
        collectives: Collectives, _: Any, shared: Array, own: Array
    ) -> tuple[Array, Array, Array]:
        return collectives.mean(shared), own, collectives.all_gather(own)[collectives.rank()]

    program = comm.program(step)
    program.trace((), jnp.zeros(4), jnp.zeros(2))
    program.compile()
    mean, _, gathered = program(jnp.asarray(values), jnp.ones(2))
    program.wait()
    assert np.asarray(mean).tobytes() == values.tobytes()
    np.testing.assert_array_equal(gathered, np.ones(2))
    assert program.exchange_s is None
    np.testing.assert_array_equal(comm.all_gather(values[2:]), [values[2:]])
    comm.close()
    comm.close()
