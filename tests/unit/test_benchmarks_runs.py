"""Figures of few runs or without a commit are refused, unless marked as such and planned."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.evaluation import check, figures
from benchmarks.evaluation.evidence import Evidence, Source, together
from benchmarks.evaluation.figures import rate, ratio, text_of, text_of_range
from benchmarks.evaluation.finding import Finding
from benchmarks.evaluation.planned import unplanned, without_commit
from benchmarks.evaluation.writer import WORD_TABLES

PLAN = """## Measured too seldom

| files with fewer than 3 runs | call |
|---|---|
{}
## Not measured at all

| `else` | |
"""
OLD = Source("old", has_origin=False)
NEW, OTHER = Source("new", has_origin=True), Source("other", has_origin=True)


def write_results(
    folder: Path, name: str, runs: dict[str, int], commit: str | None = "1234"
) -> None:
    summaries = {
        case: {
            "runs": [{"summary": {"step_per_s_train": 10.0 * n}} for n in range(1, repeats + 1)]
        }
        for case, repeats in runs.items()
    }
    call: dict[str, Any] = {"results": {"cases": summaries}, "device": "2 x NVIDIA H200"}
    call |= {"commit": commit, "date": "2026-11-27"}
    (folder / f"{name}.json").write_text(json.dumps({"format": 2, "calls": [call]}))


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "results"
    folder.mkdir()
    monkeypatch.setattr(figures, "RESULTS", folder)
    write_results(folder, "new", {"thrice": 3, "once": 1})
    write_results(folder, "old", {"thrice": 3}, commit=None)
    return folder


def refused(tmp_path: Path, table: str, evidence: Evidence | None, *seldom: str) -> list[Finding]:
    plan = tmp_path / "plan.md"
    plan.write_text(PLAN.format("".join(f"| `{name}` | 2 |\n" for name in seldom)))
    return list(unplanned({table: lambda: [("| a row |", evidence)]}, plan))


@pytest.mark.usefixtures("results")
def test_a_ratio_is_of_as_many_runs_as_the_fewer_of_both():
    gain = ratio("new", "thrice", "once")
    assert gain is not None
    assert gain == 2.0
    assert str(text_of(gain).evidence) == "H200, 1 run"
    assert str(text_of(rate("new", "thrice")).evidence) == "H200, 3 runs"
    both = text_of_range([rate("new", "thrice"), rate("old", "thrice")])
    assert str(both.evidence) == "H200, 3 runs, commit unknown"
    assert text_of(rate("none", "thrice")).evidence is None


@pytest.mark.parametrize(("unit", "text"), [("kill", "CPU, 3 kills"), ("run", "CPU, 3 runs")])
def test_figures_of_one_unit_keep_it_together(unit: str, text: str):
    kills = Evidence(17, frozenset([NEW]), "kill")
    assert str(together([kills, Evidence(3, frozenset([OTHER]), unit)])) == text


@pytest.mark.parametrize(
    "evidence", [Evidence(2, frozenset([NEW])), Evidence(3, frozenset([OLD])), Evidence(3)]
)
def test_the_front_page_refuses_few_runs_and_no_commit_even_if_planned(
    tmp_path: Path, evidence: Evidence
):
    (found,) = refused(tmp_path, "front", evidence, *(["new"] if evidence.repeats == 2 else []))
    assert "the front page wants commit and 3 runs" in found.problem
    assert refused(tmp_path, "front", Evidence(3, frozenset([NEW]))) == []


def test_other_rows_of_few_runs_are_planned(tmp_path: Path):
    once = Evidence(1, frozenset([NEW, OTHER]))
    (found,) = refused(tmp_path, "advice", once, "new")
    assert found.problem == "is CPU, 1 run, and plan.md has no row of other"
    assert refused(tmp_path, "advice", once, "new", "other") == []
    assert refused(tmp_path, "advice", None) == []


def test_a_planned_file_whose_rows_have_enough_runs_is_done(tmp_path: Path):
    (found,) = refused(tmp_path, "advice", Evidence(3, frozenset([NEW])), "new")
    assert (found.file, found.line, found.text) == ("plan.md", 5, "new")
    assert found.problem.endswith("it is done")


def test_a_row_of_words_says_the_evidence_of_its_figures():
    for table in ("front", "advice", "claims"):
        for line, evidence in WORD_TABLES[table]():
            assert evidence is None or f" | {evidence} |" in line


MARKED = "<!-- figure: new.json#{}/step_per_s_train .0f -->{}<!-- /figure -->"
THRICE, ONCE = MARKED.format("thrice", 20), MARKED.format("once", 10)


@pytest.mark.usefixtures("results")
@pytest.mark.parametrize(
    ("text", "is_refused"),
    [
        (f"It makes {THRICE}.", False),
        (f"It makes {THRICE} in three runs.", False),
        (f"It makes {THRICE} (n=4).", True),
        (f"It makes {THRICE}, the median of 4 runs.", True),
        (f"It makes {ONCE}.", True),
        (f"It makes {ONCE} (n=3).", True),
        (f"It makes {ONCE} (one run).", False),
        (f"It ran once and made {ONCE}.", False),
        (f"Eight runs at once make {THRICE}.", False),
        (f"One training of each:\n\n| a |\n|---|\n| {ONCE} |", False),
        (f"Of each:\n\n| a |\n|---|\n| {ONCE} |", True),
        (f"One run.\n\n| a | runs of each |\n|---|---|\n| {ONCE} | 3 |", True),
        (f"| a | runs of each |\n|---|---|\n| {ONCE} | 1 |", False),
    ],
)
def test_a_page_says_no_more_runs_than_a_file_has(tmp_path: Path, text: str, is_refused: bool):
    path = tmp_path / "README.md"
    path.write_text(f"# Title\n\n{text}\n")
    found = [str(one) for one in check.in_document(path, tmp_path)]
    assert len(found) == is_refused
    assert all("runs, and new.json has" in one for one in found)


def test_a_file_with_a_call_without_a_commit_is_refused(tmp_path: Path):
    for name, commits in (("some", ["abc1234", None]), ("all", ["abc1234", "abc1234"])):
        calls = [{"commit": commit, "results": {}} for commit in commits]
        (tmp_path / f"{name}.json").write_text(json.dumps({"format": 2, "calls": calls}))
    (found,) = without_commit(tmp_path)
    assert (found.file, found.text) == ("some.json", "some")


def test_lines_that_are_excused_are_counted(tmp_path: Path):
    (tmp_path / "README.md").write_text(f"It takes 3 s. {check.NO_FIGURE}\nIt is so.\n")
    assert check.excused(tmp_path) == 1
