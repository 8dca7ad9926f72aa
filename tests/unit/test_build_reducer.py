"""Strategies by name."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.collectives.build import Membership, build_reducer
from gmijax.collectives.interface import Peers
from gmijax.collectives.strategies import COSTS
from gmijax.errors import ConfigError
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import why_not_strategy
from gmijax.types import Array


def membership(num_gmis: int, num_floats: int = 4) -> Membership:
    return Membership(
        layout=Layout.even(1, num_gmis),
        rank=0,
        num_floats=num_floats,
        exchange_fd=None,
        timeout_s=1.0,
        rendezvous_timeout_s=1.0,
    )


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


def test_an_unknown_strategy_names_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"reduce.strategy=ring: expected one of none, mpr"):
        build_reducer("ring", membership(2))


def test_an_unusable_strategy_says_why() -> None:
    with pytest.raises(ConfigError, match="only for a job with one GMI, this one has 3"):
        build_reducer("none", membership(3))


def test_mpr_needs_a_shared_block() -> None:
    with pytest.raises(ConfigError, match="needs the shared block"):
        build_reducer("mpr", membership(2))


def test_one_gmi_keeps_its_own_numbers() -> None:
    reducer = build_reducer("none", membership(1))
    values = np.array([1.0, np.nan, -0.0, np.inf], np.float32)

    def step(peers: Peers, _: Any, shared: Array, own: Array) -> tuple[Array, Array, Array]:
        return peers.mean(shared), own, peers.gather(own)[peers.rank()]

    program = reducer.program(step)
    program.trace((), jnp.zeros(4), jnp.zeros(2))
    program.compile()
    mean, _, gathered = program(jnp.asarray(values), jnp.ones(2))
    program.wait()
    assert np.asarray(mean).tobytes() == values.tobytes()
    np.testing.assert_array_equal(gathered, np.ones(2))
    assert program.exchange_s is None
    np.testing.assert_array_equal(reducer.all_gather(values[2:]), [values[2:]])
    reducer.close()
    reducer.close()


def test_the_collectives_import_no_jax() -> None:
    code = "import sys, gmijax.collectives.build; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
