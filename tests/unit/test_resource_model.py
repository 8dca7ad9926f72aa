"""The resource model gives the paper's numbers for the paper's constants."""

from __future__ import annotations

import pytest

from benchmarks.paper_model import (
    Task,
    penalty,
    serving_gain,
    tcg_ex_resource,
    tcg_resource,
    tdg_ex_resource,
    tdg_resource,
    throughput,
    training_gain,
)
from gmijax.errors import ConfigError

# Section 5.1: R_s = 10 R_a = 5 R_t, T_s = 6 T_a = 3 T_t, alpha 0.2, beta 0.3.
SIMULATOR, AGENT, TRAINER = Task(6.0, 10.0), Task(1.0, 1.0), Task(2.0, 2.0)
ALPHA, BETA = 0.2, 0.3


def test_serving_penalty_of_colocation_is_016():
    # (6 * 10 + 1 * 0.2 * 1) / 7 = 8.6, and 10 / 8.6 - 1 = 0.163.
    assert tdg_resource(SIMULATOR, AGENT, ALPHA) == pytest.approx(8.6)
    resources = tcg_resource(SIMULATOR, AGENT), tdg_resource(SIMULATOR, AGENT, ALPHA)
    assert penalty(*resources) == pytest.approx(0.16, abs=0.005)


def test_serving_gains_about_two_and_a_half():
    # COM / BW = 2 (T_s + T_a): three times the time, at 1.163 times the resource.
    gain = serving_gain(SIMULATOR, AGENT, ALPHA, com_s=2 * 7.0)
    assert gain == pytest.approx(3 * 8.6 / 10)
    assert gain == pytest.approx(2.5, abs=0.1)


def test_training_penalty_of_colocation_is_about_a_half():
    # (60 + 0.2 + 2 * 0.3 * 2) / 9 = 6.82, and 10 / 6.82 - 1 = 0.466.
    dedicated = tdg_ex_resource(SIMULATOR, AGENT, TRAINER, ALPHA, BETA)
    assert dedicated == pytest.approx(61.4 / 9)
    together = tcg_ex_resource(SIMULATOR, AGENT, TRAINER)
    assert penalty(together, dedicated) == pytest.approx(0.5, abs=0.05)


def test_training_gains_about_five():
    # COM / BW = 7 (T_s + T_a + T_t): eight times the time, at 1.466 times the resource.
    gain = training_gain(SIMULATOR, AGENT, TRAINER, (ALPHA, BETA), com_s=(0.0, 7 * 9.0))
    assert gain == pytest.approx(8 / (10 / (61.4 / 9)))
    assert gain == pytest.approx(5, abs=0.5)


def test_without_communication_separation_wins_by_the_penalty():
    gain = serving_gain(SIMULATOR, AGENT, ALPHA, com_s=0.0)
    assert gain == pytest.approx(0.86)


def test_throughput_counts_instances_and_time():
    # Two and a half instances fit, each does an iteration in 7 + 3 seconds.
    assert throughput(25.0, 10.0, work_s=7.0, com_s=3.0) == pytest.approx(0.25)


def test_what_takes_no_time_has_no_throughput():
    with pytest.raises(ConfigError, match=r"total_s=0\.0: must be greater than 0"):
        tdg_resource(Task(0.0, 1.0), Task(0.0, 1.0), ALPHA)
    with pytest.raises(ConfigError, match="resource=0"):
        throughput(1.0, 0.0, 1.0, 0.0)
