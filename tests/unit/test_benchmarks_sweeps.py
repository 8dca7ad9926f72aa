"""How the benchmark of sweeps counts, and what it keeps when its time is up."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from supervision import machine

from benchmarks import sweeps
from benchmarks.records import read_calls
from benchmarks.steady import curve_of, steady_rate
from benchmarks.sweeps import Benchmark, Way

WAYS = [Way("1", "auto", ""), Way("4", "share", ""), Way("auto", "auto", "")]


def test_the_steady_rate_is_of_the_time_when_all_places_train() -> None:
    # Two at a time; the third one takes the place of the first, and compiles for five seconds.
    first = np.array([10.0, 20.0]), np.array([100.0, 200.0])
    second = np.array([15.0, 45.0]), np.array([0.0, 300.0])
    third = np.array([25.0, 40.0]), np.array([50.0, 350.0])
    # From 15 to 20: 10 + 10 steps a second; from 25 to 40: 10 + 20.
    assert steady_rate([first, second, third], 2) == pytest.approx((5 * 20 + 15 * 30) / 20)
    assert steady_rate([first, second, third], 3) is None
    assert steady_rate([], 1) is None


def test_steps_of_a_job_are_on_the_clock_of_its_sweep(tmp_path: Path) -> None:
    row = {"run_dir": str(tmp_path), "start_s": 100.0, "first_update_s": 30.0}
    assert curve_of(row) is None
    lines = [{"env_steps": 64 * n, "wall_s": 0.5 * n} for n in (1, 2, 3)]
    (tmp_path / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    curve = curve_of(row)
    assert curve is not None
    np.testing.assert_allclose(curve[0], [130.0, 130.5, 131.0])
    np.testing.assert_array_equal(curve[1], [64, 128, 192])


def benchmark(
    folder: Path, monkeypatch: pytest.MonkeyPatch, deadline_s: float | None
) -> Benchmark:
    """Sweeps of 60 s each, the third one interrupted if there is no deadline."""
    now_s = 0.0
    done: list[Way] = []

    def sweep(way: Way, repeat: int, *_: object) -> dict[str, Any]:
        nonlocal now_s
        if deadline_s is None and len(done) == 2:
            raise KeyboardInterrupt
        done.append(way)
        now_s += 60.0
        own = {"trainings_per_hour": 10.0 * len(done), "steady_steps_per_s": 5.0 * len(done)}
        return {"way": str(way), "repeat": repeat, "status": "completed", "command_s": 60.0, **own}

    monkeypatch.setattr(sweeps.time, "monotonic", lambda: now_s)
    arguments = argparse.Namespace(
        out=folder, deadline_s=deadline_s, repeats=3, warm=False, jobs=8, overrides=["env=ant"]
    )
    found = Benchmark(arguments, machine(0))
    monkeypatch.setattr(found, "_sweep", sweep)
    return found


def test_no_sweep_is_started_that_would_not_end_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = benchmark(tmp_path, monkeypatch, deadline_s=330.0)
    told.run(WAYS)
    # All of them once before one comes twice.
    assert [run["way"] for run in told.runs] == [str(way) for way in (*WAYS, *WAYS[:2])]
    medians = told.medians(WAYS)
    assert medians["1 at once, auto"]["trainings_per_hour"] == (10.0 + 40.0) / 2
    assert medians["auto at once, auto"]["sweeps"] == 1
    assert sweeps._auto_to_best(medians) == pytest.approx(30.0 / 35.0)


def test_what_is_through_is_kept_when_it_is_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(2):
        told = benchmark(tmp_path, monkeypatch, deadline_s=None)
        with pytest.raises(KeyboardInterrupt):
            told.run(WAYS)
    calls = read_calls(told.file.path)
    assert [len(call.results["runs"]) for call in calls] == [2, 2]
    assert calls[0].device == "cpu"
    assert set(calls[1].results["medians"]) == {"1 at once, auto", "4 at once, share"}
