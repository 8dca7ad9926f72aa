"""Figures in the documents are those of the files of results; what has no file is found."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from benchmarks import records
from benchmarks.cases import SUITES
from benchmarks.evaluation import check, figures, tables
from benchmarks.evaluation.async_tables import over_the_same_ratio
from benchmarks.evaluation.count import of_figure, of_table
from benchmarks.evaluation.figures import look_up
from benchmarks.evaluation.page import TABLES
from benchmarks.evaluation.sweep_tables import FINISHED, STEPS, processes_over_program
from gmijax.errors import ConfigError

REFERENCE = "runs.json#four, mps/step_per_s_train"
MARKED = (
    f"<!-- figure: {REFERENCE} over one/step_per_s_train .2f -->%s<!-- /figure --> (one run)\n"
)


def write_results(folder: Path, name: str, cases: Any, commit: str | None = "1234567") -> None:
    call = {"commit": commit, "date": "2026-11-27", "results": {"cases": cases}}
    (folder / f"{name}.json").write_text(json.dumps({"format": 2, "calls": [call]}))


def runs(*rates: float) -> dict[str, Any]:
    return {"runs": [{"summary": {"step_per_s_train": rate}} for rate in rates]}


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of results that has one file."""
    folder = tmp_path / "results"
    folder.mkdir()
    monkeypatch.setattr(figures, "RESULTS", folder)
    write_results(folder, "runs", {"four, mps": runs(70.0, 72.0, 90.0), "one": runs(100.0)})
    return folder


def findings(folder: Path, text: str) -> list[str]:
    path = folder / "README.md"
    path.write_text(text)
    return [str(finding) for finding in check.in_document(path, folder)]


def test_every_figure_of_the_documents_is_that_of_its_file():
    # `python -m benchmarks evaluation` writes what is marked, and says what a table is called.
    assert [str(finding) for finding in check.check()] == []


def test_lgr_is_what_algorithm_1_of_the_paper_takes():
    taken = {"2G2T": "mrr", "2G3T": "har", "4G4T": "mrr"}
    ways = [
        f"{at} {way}" for at, strategy in taken.items() for way in ("mpr", strategy, "one_shot")
    ]
    assert [case.name for case in SUITES["lgr-ant"]] == ways
    assert {at: tables.algorithm_1(at) for at in tables.LAYOUTS} == taken


def test_scaling_is_that_of_the_file_with_two_gpus(results: Path):
    one, two = tables.scaling(1, 1), tables.scaling(2, 1)
    assert tables.over_one_gpu() is None
    write_results(results, "scaling", {one: runs(100.0)})
    long = {"1 GPU, synchronous": runs(50.0), "2 GPUs, synchronous": runs(90.0)}
    write_results(results, "async-long", long)
    assert tables.over_one_gpu() == 1.8
    assert [row[0] for row in tables.weak_scaling()] == ["1 x 1 x 8,192", "2 x 1 x 8,192"]
    write_results(results, "scaling", {one: runs(100.0), two: runs(195.0)})
    assert tables.over_one_gpu() == 1.95


def sweeps(date: str, **rates: Sequence[float]) -> dict[str, Any]:
    found = [
        {"way": f"8 at once, {way}", "status": "completed", FINISHED: rate, STEPS: rate}
        for way, of_way in rates.items()
        for rate in of_way
    ]
    settings = {"overrides": ["env=ant"], "jobs": 8, "warm": True}
    own = {"commit": "1234567", "date": date, "device": "1 x NVIDIA H200"}
    return {**own, "settings": settings, "results": {"runs": found}}


def test_processes_and_a_program_are_compared_in_one_call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    calls = [
        sweeps("2026-11-24", auto=[50.0, 50.0], vmap=[60.0]),
        sweeps("2026-11-29", auto=[80.0, 81.0, 82.0], vmap=[90.0, 90.0, 99.0]),
        sweeps("2026-11-30", auto=[10.0] * 9),
    ]
    file = {"format": 2, "calls": calls}
    (tmp_path / "sweeps-nvidia-h200.json").write_text(json.dumps(file))
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    gain = processes_over_program(STEPS)
    assert gain is not None
    assert gain == 0.9
    assert gain.evidence.repeats == 3


@pytest.mark.usefixtures("results")
def test_what_no_file_has_is_written_once():
    assert TABLES["lgr"]() == ["not measured"]
    (row,) = (line for line in TABLES["claims"]() if "LGR over MPR" in line)
    assert row.split(" | ")[4:6] == ["not measured", ""]


def test_every_table_stands_in_one_page_of_the_evaluation():
    pages = [path for path in check.documents() if path.name != "README.md"]
    names = [match[2] for page in pages for match in check.TABLE.finditer(page.read_text())]
    assert sorted([*names, "front"]) == sorted(TABLES)


def test_the_front_page_has_its_own_figures():
    text = (check.ROOT / "README.md").read_text()
    assert {match[2] for match in check.TABLE.finditer(text)} == {"front", "advice"}


@pytest.mark.usefixtures("results")
def test_a_wrong_digit_is_found(tmp_path: Path):
    assert findings(tmp_path, "a\n" + MARKED % "0.72") == []
    (found,) = findings(tmp_path, "a\n" + MARKED % "0.73")
    assert found.startswith("README.md:2: '0.73': runs.json#")
    assert found.endswith(" is 0.72")


@pytest.mark.usefixtures("results")
def test_a_decision_says_that_its_figures_are_of_their_day(tmp_path: Path):
    path = tmp_path / "docs" / "decisions" / "why.md"
    path.parent.mkdir(parents=True)
    path.write_text("It took 26 ms.\n")
    assert len(list(check.in_document(path, tmp_path))) == 1
    path.write_text("It took 26 ms, as measured then.\n")
    assert list(check.in_document(path, tmp_path)) == []
    path.write_text("As measured then.\n" + MARKED % "0.73")
    assert len(list(check.in_document(path, tmp_path))) == 1
    assert check.documents(tmp_path) == [path]


def test_a_wrong_digit_in_a_table_is_found(tmp_path: Path):
    text = check.fill("<!-- table: async-long -->\n<!-- /table -->\n")
    assert findings(tmp_path, text) == []
    row = text.splitlines()[4]
    (found,) = findings(tmp_path, text.replace(row, row.replace("1", "2")))
    assert found.startswith(f"README.md:5: {row.replace('1', '2')!r}: the files say")
    assert row in found


@pytest.mark.usefixtures("results")
@pytest.mark.parametrize(
    ("marked", "problem"),
    [
        ("figure: none.json#a/b .2f -->0.72<!-- /figure", "no such file of results"),
        (f"figure: {REFERENCE} over none/a .2f -->0.72<!-- /figure", "runs.json has no"),
        ("table: none -->\n<!-- /table", "table none: expected one of advice, "),
    ],
)
def test_a_figure_without_a_file_and_an_unknown_table_are_found(
    tmp_path: Path, marked: str, problem: str
):
    (found,) = findings(tmp_path, f"<!-- {marked} -->\n")
    assert problem in found


@pytest.mark.parametrize(
    "text",
    [
        *("It makes 1,635,487 steps/s.", "It is 1.42 times as fast.", "4 times faster with four"),
        *("a return of 7,000", "learnt after 57 s", "0.2 M steps a second", "38 % of the GPU"),
    ],
)
def test_what_looks_like_a_measurement_needs_a_file(tmp_path: Path, text: str):
    (found,) = findings(tmp_path, f"{text}\n")
    assert found.endswith("looks like a measurement and names no file")
    assert findings(tmp_path, f"{text} <!-- no figure -->\n") == []
    assert findings(tmp_path, f"`{text}`\n```\n{text}\n```\n") == []


def test_prose_needs_no_marks(tmp_path: Path):
    text = (
        "8,192 environments, 0.91 kg, twice, within 0.2 s, 1.5M parameters, every 25 s, 600 MiB,"
    )
    text += " the mean return of 64 episodes, 5 % more"
    assert findings(tmp_path, text) == []


def test_paths_take_medians_names_and_keys_with_slashes(results: Path):
    assert look_up(REFERENCE) == 72.0  # The second of three.
    listed = [{"name": "ant 1 x 8192, mps", "colocated": 5, "medians": {"time/rollout_s": 0.5}}]
    write_results(results, "listed", listed)
    assert look_up("listed.json#ant 1 x 8192, mps/colocated") == 5
    assert look_up("listed.json#cases/0/medians/time/rollout_s") == 0.5
    with pytest.raises(ConfigError, match="has no"):
        look_up("runs.json#four, mps/none")


def test_free_gmis_are_compared_with_one_program_of_their_ratio():
    # A round takes one program 10 ms and its two updates 20 ms; the two GMIs make 50 rounds/s.
    repeat = {
        "in_turn": {"acting_alone_rounds_per_s": 100.0, "learning_alone_updates_per_s": 100.0},
        "two_gmis": {"free_rounds_per_s": 50.0, "free_updates_per_s": 100.0},
    }
    assert over_the_same_ratio(repeat) == pytest.approx(1.5)


HEAD = "| task | environments | steps/s | ratio |\n| --- | ---: | ---: | ---: |\n"
KNOWN = "- [`a.json`](a): commit 1234567, 2026-11-27, 1 x NVIDIA H200"
UNKNOWN = "- [`b.json`](b): commit unknown, date unknown, NVIDIA H200, 3 runs of each case"


@pytest.mark.parametrize(
    ("rows", "sources", "counted"),
    [
        # Environments are no figure; a ratio is of as many runs as what it is of.
        (["| ant | 8 | 5 (4 to 6, n=3) | 1.2 |"], [KNOWN], (2, 2)),
        (["| ant | 8 | 5 (4 to 6, n=2) | 1.2 |"], [KNOWN], (2, 0)),
        (["| ant | 8 | 5 | 1.2 |"], [KNOWN], (2, 0)),
        (["| ant | 8 | 5 | 1.2 |"], [f"{KNOWN}, 3 runs of each case"], (2, 2)),
        (["| ant | 8 | 5 | 1.2 |"], [f"{KNOWN}, 1 to 3 runs of each case"], (2, 0)),
        (["| ant | 8 | 5 of 20 | not measured |"], [KNOWN], (1, 1)),
        (["| ant | 8 | 5 | 1.2 |"], [UNKNOWN], (2, 0)),
        # A row may say which file it is from.
        (
            ["| `b` | 8 | 5 (4 to 6, n=3) |  |", "| `a` | 8 | 5 (4 to 6, n=3) |  |"],
            [KNOWN, UNKNOWN],
            (2, 1),
        ),
    ],
)
def test_figures_are_counted(rows: list[str], sources: list[str], counted: tuple[int, int]):
    text = HEAD + "\n".join([*rows, "", *sources]) + "\n"
    assert of_table(text) == counted


def test_marked_figures_are_counted(results: Path):
    assert of_figure(REFERENCE) == (1, 1)
    assert of_figure(f"{REFERENCE} over one/step_per_s_train") == (1, 0)  # Of one run.
    write_results(results, "runs", {"four, mps": runs(1.0, 2.0, 3.0)}, commit=None)
    assert of_figure(REFERENCE) == (1, 0)
    assert of_figure("none.json#a") == (1, 0)
