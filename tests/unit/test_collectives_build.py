"""Strategies by name."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest

from gmijax.collectives.build import STRATEGIES, Membership, build_reducer
from gmijax.collectives.memory import create_exchange
from gmijax.errors import CollectiveError, ConfigError
from gmijax.machine.nvidia import list_gpus
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import why_not_strategy


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
    assert {name for name in STRATEGIES if not why_not_strategy(name, layout)} == usable


def test_an_unknown_strategy_names_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"reduce.strategy=ring: expected one of none, mpr"):
        build_reducer("ring", membership(2))


def test_an_unusable_strategy_says_why() -> None:
    with pytest.raises(ConfigError, match="only for a job with one GMI, this one has 3"):
        build_reducer("none", membership(3))


def test_mpr_needs_a_shared_block() -> None:
    with pytest.raises(ConfigError, match="needs the shared block"):
        build_reducer("mpr", membership(2))


@pytest.mark.parametrize("strategy", ["mrr", "har", "flat"])
def test_rings_need_a_world(strategy: str) -> None:
    two_gpus = dataclasses.replace(membership(2), layout=Layout.even(2, 1))
    with pytest.raises(ConfigError, match=f"strategy={strategy}: needs a jax world"):
        build_reducer(strategy, two_gpus)


def test_an_unknown_exchange_inside_a_gpu_names_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"reduce\.intra=usb: expected one of host, ipc"):
        build_reducer("har", dataclasses.replace(membership(1), intra="usb"))


def test_one_gmi_keeps_its_own_numbers() -> None:
    reducer = build_reducer("none", membership(1))
    buffer = np.array([1.0, np.nan, -0.0, np.inf], np.float32)
    mean = reducer.mean(buffer)
    assert mean.tobytes() == buffer.tobytes()
    assert not mean.flags.writeable
    assert buffer.flags.writeable
    np.testing.assert_array_equal(reducer.all_gather(buffer[2:]), [buffer[2:]])
    with pytest.raises(CollectiveError, match="expected 4"):
        reducer.mean(buffer[1:])
    reducer.close()
    reducer.close()


def test_the_collectives_import_no_jax() -> None:
    code = "import sys, gmijax.collectives.build; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_cuda_says_why_a_gpu_cannot_be_shared() -> None:
    pytest.importorskip("cuda.bindings.runtime", reason="cuda-bindings is not installed")
    if list_gpus():
        pytest.skip("there is a GPU: tests/gpu has the rest")
    fd = create_exchange()
    given = dataclasses.replace(membership(1), intra="ipc", exchange_fd=fd)
    with pytest.raises(CollectiveError, match="cannot use the GPU: cudaError"):
        build_reducer("har", given)
    os.close(fd)
