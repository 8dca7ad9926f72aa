"""What users and GMIs write is shown as it is: no markup, nothing that a terminal obeys."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import gmijax
from gmijax.control import console, decide, evaluation, serving
from gmijax.errors import ConfigError, printable
from gmijax.supervise.failures import last_line
from gmijax.supervise.gmi_process import GmiStatus


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
    Console(file=said, width=200).print(evaluation._table(returns))
    for name in ("a[/b].py:make", "near[/]", "[red]x"):
        assert name in said.getvalue()


def test_the_panel_of_a_job_shows_what_a_gmi_says():
    said = io.StringIO()
    shown = console.ConsoleProgress(Console(file=said), lambda: None, 10)
    Console(file=said).print(shown._panel([GmiStatus(0, "[/odd]", 3, None, None)]))
    assert "GMI 0: [/odd], iteration 3" in said.getvalue()


def test_serve_refuses_a_name_that_is_taken_before_it_searches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def search(*_: Any) -> None:
        pytest.fail("searched first")

    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    monkeypatch.setattr(decide, "with_auto_decided", search)
    overrides = ("policy=random", "num_envs=auto", "run.name=mine")
    config = gmijax.compose(*overrides, command="serve")
    with pytest.raises(ConfigError, match=r"^run\.name=runs/mine: the run folder exists already$"):
        serving.serve(config)
