"""What the runner of benchmarks runs, and adds to a file that is there."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import run
from benchmarks.cases import SUITES
from benchmarks.evaluation import tables
from benchmarks.records import read_calls

SUITE, FIRST, SECOND = "lgr-ant", "2G2T mpr", "4G4T mrr"
CASES = SUITES[SUITE]
SUMMARY = {**dict.fromkeys(run.RATES, 2.0), "final_return": 1.0, "device": {"peak_memory_mib": 1}}


def test_lgr_is_what_algorithm_1_of_the_paper_takes():
    taken = {"2G2T": "mrr", "2G3T": "har", "4G4T": "mrr"}
    pairs = [f"{at} {way}" for at, strategy in taken.items() for way in ("mpr", strategy)]
    assert [case.name for case in CASES] == pairs
    assert {at: tables.algorithm_1(at) for at in tables.LAYOUTS} == taken
    measured = tables.gain_of("ant", "2G2T", "mrr")  # By itself, in a file of its own.
    assert measured.ratio == pytest.approx(0.99, abs=0.005)


def test_only_what_is_missing_is_run_and_what_failed_again():
    runs = [{"repeat": 0, "failed": "why"}, {"repeat": 1, "summary": {}}]
    results = {"cases": {FIRST: {"runs": runs}, SECOND: {"runs": []}}}
    wanted = [(repeat, case.name) for repeat, case in run.missing(results, CASES[:1], 3, None)]
    assert wanted == [(0, FIRST), (2, FIRST)]
    assert run.missing(results, CASES[-1:], 1, 2) == []  # It needs four GPUs.
    assert run.failures(results) == [FIRST]
    runs.append({"repeat": 0, "summary": {}})
    assert run.failures(results) == []


def test_running_again_adds_a_call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made: list[int] = []

    def run_case(*_: Any) -> dict[str, Any]:
        made.append(len(made))
        return {"summary": SUMMARY, "config": {"seed": len(made)}}

    monkeypatch.setattr(run, "run_case", run_case)
    command = ["run", SUITE, "--only", FIRST, "--repeats", "2", "--out", str(tmp_path)]
    for more in ((), (), ("--resume",)):
        monkeypatch.setattr(sys, "argv", [*command, *more])
        assert run.main() == 0
    calls = read_calls(tmp_path / f"{SUITE}.json")
    assert len(made) == 4  # There was nothing to resume.
    assert [list(call.results["cases"]) for call in calls] == [[FIRST], [FIRST]]
    case = calls[1].results["cases"][FIRST]
    assert [one["repeat"] for one in case["runs"]] == [0, 1]
    assert case["config"] == {"seed": 4}
