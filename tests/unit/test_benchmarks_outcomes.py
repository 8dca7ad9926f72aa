"""What counts as a success, and how seeds of two settings are compared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from benchmarks.outcomes import (
    WINDOW,
    Outcome,
    against,
    outcome_of,
    quartiles,
    return_curve,
    seconds_to,
    succeeded,
    summary,
    wilson,
)


def lines(rewards: Sequence[float], **others: Any) -> list[dict[str, Any]]:
    return [
        {"env_steps": 64 * n, "wall_s": 0.5 * n, "reward_per_step": reward, **others}
        for n, reward in enumerate(rewards)
    ]


def outcome(final: float, *, ok: bool) -> Outcome:
    return Outcome("0", ok, final, 1.0, 1.0, 10.0, 0.0, {"policy/noise_std_min": final})


def test_a_reward_that_stays_near_its_peak_is_a_success() -> None:
    rise = [0.01 * n for n in range(100)]
    assert succeeded("ball_balance", lines(rise))
    assert succeeded("ball_balance", lines([*rise, *[0.9] * WINDOW]))
    assert not succeeded("ball_balance", lines([*rise, *[0.8] * WINDOW]))
    # A fall that was made good again is none.
    assert succeeded("ball_balance", lines([*rise, *[0.3] * 50, *[0.95] * WINDOW]))


def test_one_high_iteration_is_no_peak() -> None:
    assert succeeded("ball_balance", lines([*[0.5] * 50, 0.9, *[0.5] * 50]))


def test_without_a_finite_reward_there_is_no_success() -> None:
    assert not succeeded("ball_balance", [])
    assert not succeeded("ball_balance", [{"reward_per_step": None}])
    assert not succeeded("ball_balance", lines([0.5, float("nan")]))
    assert succeeded("ball_balance", lines([0.5]))


def test_a_drawer_must_be_open_and_no_reward_makes_up_for_it() -> None:
    hovering = [0.01 * n for n in range(50)]
    assert not succeeded("franka_cabinet", lines(hovering, **{"metric/opened": 0.94}))
    assert succeeded("franka_cabinet", lines(hovering[::-1], **{"metric/opened": 0.95}))
    assert not succeeded("franka_cabinet", lines(hovering))


def test_an_outcome_has_what_the_last_iterations_show() -> None:
    early = {"policy/noise_std_min": 0.5, "diverged_steps": 1.0, "return": 10.0}
    late = {"policy/noise_std_min": 0.1, "diverged_steps": 2.0, "return": 20.0}
    found = lines([1.0] * 20, **early) + lines([0.5] * 20, **late)
    one = outcome_of("ball_balance", found, seed="3", completed=True, wall_s=9.0)
    assert (one.seed, one.succeeded) == ("3", False)
    assert (one.final_return, one.diverged_steps) == (20.0, 60.0)
    assert (one.final, one.peak) == (pytest.approx(0.5), pytest.approx(1.0))
    assert one.at_end == {"policy/noise_std_min": pytest.approx(0.1)}
    found[10] |= {"eval/return": 360.0}
    found[20] |= {"eval/return": 150.0}
    one = outcome_of("ball_balance", found, seed="3", completed=True, wall_s=9.0)
    assert (one.at_end["eval/last"], one.at_end["eval/peak"]) == (150.0, 360.0)
    # What did not get to its end has not succeeded, however good it was.
    found = lines([1.0] * 20)
    assert outcome_of("ball_balance", found, seed="", completed=True, wall_s=0.0).succeeded
    assert not outcome_of("ball_balance", found, seed="", completed=False, wall_s=0.0).succeeded


def test_seconds_to_a_mark_are_counted_from_the_first_line() -> None:
    found = lines([1.0] * 200, **{"return": None})
    for line in found[100:]:
        line |= {"return": -line["env_steps"]}
    curve = return_curve(found)
    assert len(curve) < 80
    assert (curve[0][:2], curve[-1][:2]) == ((0, 0.0), (64 * 199, 99.5))
    assert seconds_to(-8000.0, curve[5:]) == pytest.approx(102 * 0.5 - curve[5][1], abs=1.0)
    assert seconds_to(0.0, curve) is None
    assert return_curve([]) == []


def test_wilsons_interval() -> None:
    # Wilson 1927; figures of R's binom.confint(17, 20, methods = "wilson").
    assert wilson(17, 20) == pytest.approx([0.6396, 0.9476], abs=1e-4)
    assert wilson(0, 0) is None
    low_high = wilson(20, 20)
    assert low_high is not None
    assert low_high[0] == pytest.approx(1 / (1 + 1.959964**2 / 20), abs=1e-4)


def test_p_against_the_baseline() -> None:
    good, bad = [outcome(0.9, ok=True)] * 20, [outcome(0.1, ok=False)] * 5
    # 15 of 20 against 20 of 20.
    mixed = [*good[:15], *bad]
    assert against(good, mixed)["p_successes"] == pytest.approx(0.0471, abs=1e-4)
    assert against(mixed, mixed) == {"p_successes": 1.0, "p_final": pytest.approx(1.0)}
    low = [outcome(0.1 + 0.001 * n, ok=True) for n in range(20)]
    high = [outcome(0.2 + 0.001 * n, ok=True) for n in range(20)]
    p_final = against(high, low)["p_final"]
    assert p_final is not None
    assert p_final < 1e-6
    assert against([], low) == {"p_successes": None, "p_final": None}


def test_a_summary_counts_and_has_quartiles() -> None:
    found = summary([outcome(0.1 * n, ok=n > 1) for n in range(5)])
    assert (found["seeds"], found["successes"], found["diverged_steps"]) == (5, 3, 0.0)
    assert found["final"] == pytest.approx([0.1, 0.2, 0.3])
    assert found["at_end"]["policy/noise_std_min"] == pytest.approx([0.1, 0.2, 0.3])
    assert summary([])["wilson"] is None
    assert quartiles([None]) is None
