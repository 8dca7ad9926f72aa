"""Serving with several numbers of environments: what runs, and which side is fastest where."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from benchmarks import records, serving
from benchmarks.evaluation import serving_tables
from benchmarks.evaluation.serving_tables import peak_over_peak
from benchmarks.evaluation.writer import TABLES
from benchmarks.serving import settings_of


def case(simulators: int, num_envs: int, *rates: float, task: str = "ant") -> dict[str, Any]:
    runs = {"tcg": [{"step_per_s_inference": rate} for rate in rates], "tdg": []}
    size = {"task": task, "backend": "mps", "simulators": simulators, "num_envs": num_envs}
    median = sorted(rates)[len(rates) // 2]
    return {"name": f"{simulators} x {num_envs}", **size, "runs": runs, "colocated": median}


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for module in (records, serving_tables):
        if hasattr(module, "RESULTS"):
            monkeypatch.setattr(module, "RESULTS", tmp_path)
    return tmp_path / "serving-nvidia-h200.json"


def write(file: Path, *calls: list[dict[str, Any]]) -> None:
    made = [
        {"commit": "abc", "date": f"2026-11-{day}", "results": {"cases": cases}}
        for day, cases in enumerate(calls, 10)
    ]
    file.write_text(json.dumps({"format": 2, "calls": made}))


def test_every_number_of_environments_is_split_over_every_number_of_gmis():
    given = argparse.Namespace(
        tasks=["ant"], backends=["mps"], simulators=[1, 2], envs=[64, 256], templates=["tcg"]
    )
    found = {(one.simulators, one.num_envs) for one in settings_of(given)}
    assert found == {(1, 64), (2, 32), (1, 256), (2, 128)}


def test_a_case_that_would_not_end_in_time_is_not_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    now_s = [0.0]

    def lasting(setting: serving.Setting, *_: object) -> dict[str, Any]:
        now_s[0] += 30.0
        return case(setting.simulators, setting.num_envs, 10)

    monkeypatch.setattr(serving, "measure", lasting)
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    words = ["serving", "--tasks", "ant", "--templates", "tcg", "--envs", "64", "256"]
    monkeypatch.setattr(sys, "argv", [*words, "--deadline-s", "100", "--out", str(tmp_path)])
    assert serving.main() == 0
    (file,) = tmp_path.iterdir()
    (call,) = records.read_calls(file)
    assert len(call.results["cases"]) == 3


def test_each_side_is_taken_at_its_own_best_number_of_environments(results: Path):
    peaks = [case(1, 64, 10, 11, 12), case(1, 256, 39, 40, 41), case(2, 32, 20, 30, 40)]
    peaks += [case(2, 128, 25, 25, 25)]
    write(results, peaks, [case(1, 64, 1000), case(2, 32, 1)])
    gain = peak_over_peak("ant")
    assert gain is not None
    assert gain == 0.75
    assert gain.evidence.repeats == 3
    table = "\n".join(TABLES["serving-peaks"]())
    assert "| `ant` | 1 x 256 | 40 (39 to 41, n=3) | 2 x 32 | 30 (20 to 40, n=3) | 0.75 |" in table
    assert peak_over_peak("humanoid") is None


def test_a_later_call_of_another_task_hides_nothing(results: Path):
    write(
        results,
        [case(1, 64, 10), case(1, 128, 20), case(2, 32, 30)],
        [case(n, size, 10 * n, task="humanoid") for n in (1, 2) for size in (32, 64)],
    )
    assert (peak_over_peak("ant"), peak_over_peak("humanoid")) == (1.5, 2.0)


def test_one_size_is_no_peak(results: Path):
    write(results, [case(1, 64, 1000), case(2, 32, 1)])
    assert peak_over_peak("ant") is None
    assert TABLES["serving-peaks"]() == ["not measured"]
