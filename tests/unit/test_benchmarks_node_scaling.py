"""Predicted scaling to several nodes: by hand, and that it moves as it must."""

from __future__ import annotations

import sys

import pytest

from benchmarks import node_scaling as scaling
from benchmarks import runner
from benchmarks.evaluation.figures import rate
from benchmarks.runner import exit_code

KNOWN = scaling.Measured({"ant": 0.07, "shadow_hand": 0.075}, 1.4e9, 34e9)


def test_an_efficiency_is_that_of_the_formulas_by_hand():
    num_bytes = 4 * 110_000
    inside_s = 2 * 7 * num_bytes / (8 * 1.4e9)
    between_s = 2 * 3 * num_bytes / (4 * 100e9 / 8)
    messages_s = 2 * 3 * 20e-6
    exchanges_s = 17 * 10 * (inside_s + between_s + messages_s)
    assert scaling.efficiency(KNOWN, "ant", "mpr", 4, 100, 20, 10) == pytest.approx(
        0.07 / (0.07 + exchanges_s)
    )


@pytest.mark.parametrize("task", scaling.TRAININGS)
def test_more_nodes_slower_networks_and_longer_messages_cost(task: str):
    def at(nodes: int, gbit: float = 100, us: float = 50, times: float = 1) -> float:
        return scaling.efficiency(KNOWN, task, "flat", nodes, gbit, us, times)

    assert 0 < at(64) < at(8) < 1
    assert max(at(8, gbit=25), at(8, us=500), at(8, times=10)) < at(8)


def test_where_it_breaks_is_the_first_number_of_nodes_below_the_mark():
    network = (100.0, 50.0)
    first = scaling.breaks_at(KNOWN, "ant", "flat", *network)
    assert first is not None
    assert scaling.efficiency(KNOWN, "ant", "flat", first, *network) < scaling.ENOUGH
    assert scaling.efficiency(KNOWN, "ant", "flat", first - 1, *network) >= scaling.ENOUGH
    assert scaling.breaks_at(KNOWN, "ant", "flat", 1e6, 0) is None


def test_what_was_measured_is_from_the_files():
    known, steps_per_s = scaling.measured(), rate(scaling.RATES, "ant warp 8192")
    assert steps_per_s is not None
    assert 8192 * 16 / known.iteration_s["ant"] == pytest.approx(steps_per_s.median)
    assert 1e8 < known.b1 < known.b2 < 1e12  # Host memory, then a ring of GPUs, in bytes/s.
    assert all(0.1 < fit < 100 for way in scaling.PATHS for fit in scaling.model_fit(way))


def test_iterations_are_as_the_tuned_settings_have_them():
    from gmijax import compose
    from gmijax.config import RolloutConfig

    for task, training in scaling.TRAININGS.items():
        algo = compose(f"env={task}").algo
        assert isinstance(algo, RolloutConfig)
        exchanges = algo.num_minibatches * algo.num_updates_per_batch + 1
        assert (training.unroll_length, training.exchanges) == (algo.unroll_length, exchanges)


@pytest.mark.parametrize("bad", [["--gbit-per-s", "0"], ["--message-us", "-1"]])
def test_bad_input_is_one_line(bad: list[str], monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["node_scaling", *bad])
    monkeypatch.setattr(runner.signal, "signal", lambda *_: None)
    assert exit_code(scaling.main) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
