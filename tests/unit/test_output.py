"""What a job prints cannot end it, and holds no markup and nothing that a terminal obeys."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rich.text import Text
from supervision import CHECKOUT, machine

from gmijax.config import PlanConfig, ReduceConfig
from gmijax.control.console import ConsoleProgress, announce, doing, nearby, open_console
from gmijax.control.display import LiveDisplay
from gmijax.control.summary import train_outcome
from gmijax.deploy import playing
from gmijax.errors import printable
from gmijax.partition.planner import make_plan
from gmijax.runs.folder import RunPaths
from gmijax.supervise.failures import last_line
from gmijax.supervise.watched_gmi import GmiStatus

PRINTS = """
from gmijax.control.console import open_console
console = open_console(show=True)
for number in range(8_000):
    console.print(f"line {number}")
open("done", "w").close()
"""


@pytest.mark.parametrize("shell", ["{0} | head -n 1", "{0} >&-", "{0} > /dev/full"])
def test_a_reader_that_is_gone_does_not_end_the_job(tmp_path: Path, shell: str):
    (tmp_path / "prints.py").write_text(PRINTS)
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {shell.format(f'{sys.executable} prints.py')}"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "done").exists()


def test_names_in_brackets_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]):
    open_console(show=True).print("runs/[lr=0.1] a[/b]")
    assert capsys.readouterr().out == "runs/[lr=0.1] a[/b]\n"


@pytest.mark.parametrize("variable", ["FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"])
def test_nothing_moves_where_there_is_no_terminal(
    variable: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Notebooks set FORCE_COLOR for what they run, and show every frame of a spinner."""
    monkeypatch.setenv(variable, "1")
    console = open_console(show=True)
    with doing(console, "playing"), LiveDisplay(console) as display:
        display.show(lambda: Text("a panel"))
    assert not display.has_panel
    assert capsys.readouterr().out == "playing\n"


def test_a_display_that_fails_is_given_up(capsys: pytest.CaptureFixture[str]):
    def broken() -> None:
        raise RuntimeError("off")

    progress = ConsoleProgress(open_console(show=True), broken, 100)
    for _ in range(2):
        progress.update((GmiStatus(0, "running", 1, 1, None),))
    assert capsys.readouterr().out == "no progress from here on: RuntimeError('off')\n"


SYNC = {"env_steps": 500, "env_steps_per_s": 1234.5, "return": 7.25}
EXPERIENCE = {
    **{"async/pps": 2000.0, "async/ttop": 1500.0, "async/staleness_mean": 2.5},
    **{"channel/occupancy": 0.25, "channel/bytes_per_s": 3e6},
}
UNKNOWN = ("async/staleness_mean", "channel/occupancy")


@pytest.mark.parametrize(
    ("more", "part"),
    [
        ({}, "50 %  500 steps  1,234 steps/s  return 7.25"),
        (EXPERIENCE, "PPS 2,000  TTOP 1,500  staleness 2.5  channels 25% full, 3 MB/s"),
        (EXPERIENCE | dict.fromkeys(UNKNOWN), "staleness -  channels - full"),
    ],
)
def test_a_job_tells_its_rate_and_return_or_of_its_channels(more: dict[str, Any], part: str):
    assert part in _told([{**SYNC, **more}])


def test_a_job_tells_its_latest_evaluation():
    evaluated = {**SYNC, "eval/return": 9.5}
    assert "return 7.25  eval 9.50  ETA" in _told([evaluated, SYNC])
    assert "eval" not in _told([SYNC])


def test_without_a_terminal_a_line_is_printed_once():
    assert len(_lines([SYNC])) == 1


@pytest.mark.parametrize(
    ("rates", "line"),
    [
        ((30.0, 20.0, 1000.0), "30 simulation, 20 with inference, 1,000 with training"),
        ((None, None, 1000.0), "1,000 with training"),
        ((None, None, None), ""),
    ],
)
def test_a_summary_has_the_rates_that_were_measured(
    tmp_path: Path, rates: tuple[float | None, ...], line: str
):
    names = ("step_per_s_sim", "step_per_s_inference", "step_per_s_train")
    summary = {
        **{"status": "completed", "env_steps": 10, "wall_s": 1.0, "restarts": [], "eval": None},
        **{"final_return": None, "checkpoint": None, "overflow_steps": {}},
        **dict(zip(names, rates, strict=True)),
    }
    told = train_outcome(summary, RunPaths(tmp_path)).splitlines()
    assert [text for text in told if "steps/s" in text] == [f"env steps/s: {line}"] * bool(line)
    assert told[0].endswith("in 1 s, no episode has ended")


def _told(lines: list[dict[str, Any]]) -> str:
    """What is told in the end of a job that wrote these lines at once."""
    return _lines(lines)[-1]


def _lines(lines: list[dict[str, Any]]) -> list[str]:
    left, said = list(lines), io.StringIO()

    def new() -> list[dict[str, Any]]:
        found = left.copy()
        left.clear()
        return found

    with ConsoleProgress(Console(file=said, width=300, markup=False), new, 1000) as progress:
        progress.update(())
    return said.getvalue().splitlines()


def test_the_panel_of_a_job_shows_what_a_gmi_says():
    said = io.StringIO()
    shown = ConsoleProgress(Console(file=said), list, 10)
    Console(file=said).print(shown._panel([GmiStatus(0, "[/odd]", 3, None, None)]))
    assert "GMI 0: [/odd], iteration 3" in said.getvalue()


def test_while_it_compiles_a_job_says_why_and_for_how_long():
    shown = ConsoleProgress(Console(file=io.StringIO()), list, 10)
    said = io.StringIO()
    Console(file=said, width=120).print(shown._panel([GmiStatus(0, "compiling", 0, None, None)]))
    assert "compiling: once for each task and size, usually 1 to 3 minutes  0:00:0" in (
        said.getvalue()
    )
    assert "iteration" not in said.getvalue()
    plain = io.StringIO()
    with ConsoleProgress(Console(file=plain, width=200), list, 10) as progress:
        for state in ("starting", "compiling", "compiling"):
            progress.update((GmiStatus(0, state, 0, None, None),))
    assert plain.getvalue().splitlines() == [
        "[GMI 0 starting]",
        "compiling: once for each task and size, usually 1 to 3 minutes  [GMI 0 compiling]",
    ]


@pytest.mark.parametrize("gmis", [1, 2])
def test_one_process_needs_no_words_of_several(gmis: int, tmp_path: Path) -> None:
    here = machine(0)
    plan = make_plan(PlanConfig(gmis_per_gpu=gmis), ReduceConfig(), 64, here)
    said = io.StringIO()
    announce(Console(file=said, width=300), RunPaths(tmp_path), plan, "template x", ["note"])
    text = said.getvalue()
    assert ("one process on the CPU, 64 environments" in text) == (gmis == 1)
    for word in ("template", "strategy", "layout", "virtual"):
        assert (word in text) == (gmis > 1)
    assert "  note" in text


def test_a_run_ends_with_what_to_do_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = RunPaths(tmp_path / "runs" / "a b")
    rates = dict.fromkeys(("step_per_s_sim", "step_per_s_inference", "step_per_s_train"))
    summary = {
        **{"status": "completed", "env_steps": 10, "wall_s": 1.0, "restarts": [], "eval": None},
        **{"final_return": 58.8, "checkpoint": str(run.checkpoint(10)), "overflow_steps": {}},
        **rates,
    }
    told = train_outcome(summary, run)
    assert "final return 58.80 (mean of the latest episodes, with exploration noise)" in told
    assert "checkpoint: runs/a b/checkpoints/000000000010\n" in told
    assert "next: gmijax play run.dir='runs/a b'" in told
    assert "next" not in train_outcome({**summary, "checkpoint": None}, run)
    monkeypatch.chdir("/")
    assert nearby(run.root) == str(run.root).removeprefix("/")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain text, ä and 日本", "plain text, ä and 日本"),
        ("\x1b[31mred\x1b[0m", "red"),
        ("\x1b]0;title\x07after", "after"),
        ("\x1b]8;;http://x\x1b\\link", "link"),
        ("\x1b[2J\x1b[1;1Hover", "over"),
        ("\x1bcreset", "reset"),
        ("a\tb\x00\x08\x7f\x9b", "a b"),
        ("left\u202eright", "leftright"),
        ("half\x1b", "half"),
    ],
)
def test_what_a_terminal_would_obey_is_gone(text: str, shown: str):
    assert printable(text) == shown


def test_the_last_line_of_a_gmi_is_printable(tmp_path: Path):
    log = tmp_path / "stderr.log"
    log.write_bytes(b"first\n\x1b[31mValueError: [b]\xff\x1b[0m\x07\n\x1b[0m\n\n")
    assert last_line(log) == "ValueError: [b]\ufffd"


def test_names_in_the_table_of_play_may_look_like_markup():
    row = dict.fromkeys(("mean", "std", "min", "max"), 1.0)
    numbers = ("num_envs", "num_terminated", "num_truncated", "num_cut_off", "num_diverged")
    returns: dict[str, Any] = {
        **dict.fromkeys((*numbers, "env_steps", "compile_s", "run_s"), 1),
        "env": "a[/b].py:make",
        "deterministic": True,
        "return": row,
        "length": row,
        "terms": {"near[/]": row},
        "metrics": {"[red]x": row},
    }
    said = io.StringIO()
    Console(file=said, width=200, markup=False).print(playing._table(returns))
    for name in ("a[/b].py:make", "near[/]", "[red]x"):
        assert name in said.getvalue()
