"""What the runner of benchmarks keeps of a file that is there."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.run import ResultsFile

SUITE, FIRST, SECOND = "lgr-ant-mrr", "2G2T mrr", "4G4T mrr"


def _on_disk(path: Path) -> Path:
    runs = [{"summary": {}}, {"failed": "why"}]
    path.write_text(json.dumps({"cases": {name: {"runs": runs} for name in (FIRST, SECOND)}}))
    return path


def test_cases_that_are_kept_lose_what_failed_only(tmp_path: Path) -> None:
    book = ResultsFile(_on_disk(tmp_path / "a.json"), SUITE, keep={FIRST})
    kept, fresh = (book.results["cases"][name] for name in (FIRST, SECOND))
    assert kept["runs"] == [{"summary": {}}]
    assert fresh["runs"] == []


def test_only_what_is_wanted_and_missing_is_run(tmp_path: Path) -> None:
    book = ResultsFile(_on_disk(tmp_path / "a.json"), SUITE, keep={FIRST})
    wanted = [(repeat, case.name) for repeat, case in book.missing({FIRST}, 2, None)]
    assert wanted == [(1, FIRST)]
    assert [case.name for _, case in book.missing({FIRST, SECOND}, 1, 4)] == [SECOND]
    assert book.missing({SECOND}, 1, 2) == []
