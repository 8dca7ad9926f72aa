"""Files of results say what they are from, and keep every call."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from benchmarks import records
from benchmarks.records import COMMIT_VARIABLE, RESULTS, ResultsFile, add_calls, read_calls
from gmijax.errors import ConfigError


def add(path: Path, number: int, **options: bool) -> None:
    with ResultsFile(path, "a", {"out": path, "sizes": (1, 2)}, **options).changing() as results:
        results["number"] = number


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(COMMIT_VARIABLE, "abc-dirty")
    return tmp_path / "a.json"


def test_a_call_says_with_what_it_was_made(file: Path):
    add(file, 1)
    (call,) = read_calls(file)
    assert (call.commit, call.is_dirty) == ("abc", True)
    assert call.settings == {"out": str(file), "sizes": [1, 2]}
    assert all((call.date, call.host, call.device, call.command))
    assert call.versions is not None
    assert call.versions["jax"]


def test_calls_that_go_on_at_the_same_time_keep_each_other(file: Path):
    books = [ResultsFile(file, "a", {}) for _ in range(2)]
    for number, book in enumerate((*books, books[0])):
        with book.changing() as results:
            results["number"] = number
    assert sorted(call.results["number"] for call in read_calls(file)) == [1, 2]


def test_calls_of_another_machine_are_added_once(file: Path, tmp_path: Path):
    results = tmp_path / "results"
    results.mkdir()
    add(results / file.name, 1)
    add(file, 2)
    for _ in range(2):
        add_calls([file], results)
    calls = read_calls(results / file.name)
    assert [call.results["number"] for call in calls] == [1, 2]
    assert calls[1] == read_calls(file)[0]
    with pytest.raises(ConfigError, match="no such file of results"):
        add_calls([tmp_path / "none.json"], results)


def test_only_a_call_of_the_same_code_is_gone_on_with(file: Path, monkeypatch: pytest.MonkeyPatch):
    add(file, 1)
    add(file, 2, resume=True)
    assert [call.results for call in read_calls(file)] == [{"number": 2}]
    monkeypatch.setenv(COMMIT_VARIABLE, "def")
    with pytest.raises(ConfigError, match="its last call has another commit"):
        add(file, 3, resume=True)


@pytest.mark.parametrize("found", [{"suite": "a", "cases": {}}, {"format": 3, "calls": []}])
def test_a_file_of_another_format_is_refused_and_stays(file: Path, found: dict[str, Any]):
    file.write_text(json.dumps(found))
    with pytest.raises(ConfigError, match=r"format=\w+: expected 2"):
        add(file, 2)
    assert json.loads(file.read_text()) == found


def test_the_commit_of_a_checkout_is_found(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv(COMMIT_VARIABLE, raising=False)
    answers = {"rev-parse": "abc\n", "status": " M a\n"}

    def run(command: Sequence[str], **_: Any) -> subprocess.CompletedProcess[str]:
        answer = answers.get(command[1])
        return subprocess.CompletedProcess(command, answer is None, answer or "", "")

    monkeypatch.setattr(records.subprocess, "run", run)
    assert records.code_version() == ("abc", True)
    answers.clear()
    assert records.code_version() == (None, None)


def test_every_file_of_results_can_be_read():
    for path in RESULTS.glob("*.json"):
        assert all(call.results for call in read_calls(path)), path
