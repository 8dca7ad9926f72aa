"""Steps per second of runs: of one, of several at the same time, of a mix."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.steady import curve_of, rate_of_jobs, settled_rate, steady_rate


def test_the_rate_is_of_what_is_behind_a_fifth_of_the_steps():
    # The first program compiles for 40 seconds, then 100 steps take a second.
    curve = [(40.0, 100), (41.5, 200), (42.5, 300), (43.5, 400), (46.5, 1000)]
    assert settled_rate(curve) == pytest.approx(800 / 5)
    assert settled_rate(curve[:1]) is None


def test_the_steady_rate_is_of_the_time_when_all_places_train():
    # Two at a time; the third one takes the place of the first, and compiles for five seconds.
    first = np.array([10.0, 20.0]), np.array([100.0, 200.0])
    second = np.array([15.0, 45.0]), np.array([0.0, 300.0])
    third = np.array([25.0, 40.0]), np.array([50.0, 350.0])
    # From 15 to 20: 10 + 10 steps a second; from 25 to 40: 10 + 20.
    assert steady_rate([first, second, third], 2) == pytest.approx((5 * 20 + 15 * 30) / 20)
    assert steady_rate([first, second, third], 3) is None
    assert steady_rate([], 1) is None


def test_steps_of_a_job_are_on_the_clock_of_its_sweep(tmp_path: Path):
    row = {"run_dir": str(tmp_path), "start_s": 100.0, "first_update_s": 30.0}
    assert curve_of(row) is None
    lines = [{"env_steps": 64 * n, "wall_s": 0.5 * n} for n in (1, 2, 3)]
    (tmp_path / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    curve = curve_of(row)
    assert curve is not None
    np.testing.assert_allclose(curve[0], [130.0, 130.5, 131.0])
    np.testing.assert_array_equal(curve[1], [64, 128, 192])


@pytest.mark.parametrize(
    ("steps", "total"), [((100, 120), 12.0), ((100, 1000), None), ((100, 0), None)]
)
def test_rates_of_unlike_jobs_are_not_added_up(steps: tuple[int, ...], total: float | None):
    jobs = [{"state": "completed", "env_steps": n, "env_steps_per_s": 6.0} for n in steps]
    assert rate_of_jobs(jobs) == total
    # What did not come to its end says nothing about its kind.
    assert rate_of_jobs([{**job, "state": "failed"} for job in jobs]) == 12.0
