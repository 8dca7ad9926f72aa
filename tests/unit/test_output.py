"""What a job prints cannot end it, and holds no markup and nothing that a terminal obeys."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rich.text import Text
from supervision import CHECKOUT, machine

from gmijax.cli.compose import compose
from gmijax.cli.grid import build_sweep
from gmijax.cli.pack import build_pack
from gmijax.config import PlanConfig, ReduceConfig
from gmijax.control import phases, progress, time_left
from gmijax.control.console import Show, announce, doing, nearby, open_console, print_next
from gmijax.control.display import LiveDisplay
from gmijax.control.progress import ConsoleProgress
from gmijax.control.summary import next_steps, train_outcome, train_summary
from gmijax.control.time_left import TimeLeft
from gmijax.deploy import playing
from gmijax.errors import printable
from gmijax.partition.planner import make_plan
from gmijax.runs.compile_times import CompileTime
from gmijax.runs.folder import RunPaths, write_json
from gmijax.supervise.failures import last_line
from gmijax.supervise.stop_signals import StopSignals
from gmijax.supervise.watched_gmi import GmiStatus
from gmijax.sweeps.view import SweepView

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


PLAY_SHIPPED = "play env=ball_balance checkpoint=shipped"


@pytest.mark.parametrize(
    ("line", "name", "unbuffered"),
    [
        ("play --help", "gmijax.play", "1"),
        ("play --help", "gmijax.play", ""),
        ("play --cfg job", "gmijax.play", ""),
        (f"{PLAY_SHIPPED} num_envs=1 max_steps=5 video=none html=off", "gmijax.play", "1"),
        (f"{PLAY_SHIPPED} num_envs=1 max_steps=5 video=none html=off", "gmijax.play", ""),
        ("list-envs", "gmijax.list_envs", "1"),
        ("list-envs", "gmijax.list_envs", ""),
        ("doctor --help", "gmijax.doctor", "1"),
        ("--version", "gmijax", ""),
        ("-sc install=bash", "gmijax.completion", "1"),
        ("-sc install=bash", "gmijax.completion", ""),
    ],
)
def test_a_command_that_cannot_print_its_answer_has_failed(
    line: str, name: str, unbuffered: str, tmp_path: Path
):
    found = []
    for shell in ("{} > /dev/full", "{} >&-", "{} | true"):
        command = shell.format(f"{sys.executable} -m gmijax {line}")
        done = subprocess.run(
            ["bash", "-c", f"set -o pipefail; {command}"],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(CHECKOUT), "PYTHONUNBUFFERED": unbuffered},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        found.append((done.returncode, done.stderr))
    message = f"{name}: the output cannot be written "
    assert found[:2] == [
        (1, f"{message}(No space left on device)\n"),
        (1, f"{message}(it is closed)\n"),
    ]
    assert found[2] == (0, "")  # A reader that is gone has read enough.


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
    assert capsys.readouterr().out == "progress is no longer shown: RuntimeError('off')\n"


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
    assert part in _last_line([{**SYNC, **more}])


def test_a_job_tells_its_latest_evaluation():
    evaluated = {**SYNC, "eval/return": 9.5}
    assert _last_line([evaluated, SYNC]).endswith("return 7.25  eval 9.50")
    assert "eval" not in _last_line([SYNC])


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
    summary = {**SUMMARY, "final_return": None, **dict(zip(RATES, rates, strict=True))}
    lines = train_outcome(summary, RunPaths(tmp_path)).splitlines()
    assert [text for text in lines if "steps/s" in text] == [f"env steps/s: {line}"] * bool(line)
    assert lines[:2] == ["completed: 10 env steps in 0:01", "no episode has ended"]


def test_a_run_that_ended_in_its_first_iteration_says_so(tmp_path: Path):
    run, config = RunPaths(tmp_path), compose()
    plan = make_plan(config.plan, config.reduce, 64, machine(0))
    summary = train_summary(config, plan, run, "failed", 1.0, [])
    assert summary["env_steps"] is None
    lines = train_outcome(summary, run).splitlines()
    assert lines[:2] == ["failed: no env steps in 0:01", "no episode has ended"]


def _last_line(lines: list[dict[str, Any]]) -> str:
    """The last line of output for a job that wrote these lines at once."""
    return _lines(lines)[-1]


def _lines(lines: list[dict[str, Any]]) -> list[str]:
    left, output = list(lines), io.StringIO()

    def new() -> list[dict[str, Any]]:
        found = left.copy()
        left.clear()
        return found

    with ConsoleProgress(Console(file=output, width=300, markup=False), new, 1000) as progress:
        progress.update(())
    return output.getvalue().splitlines()


def panel(gmis: Sequence[GmiStatus], *lines: dict[str, Any], num_timesteps: int = 10) -> str:
    """What a terminal of eighty columns shows while it is open."""
    output = io.StringIO()
    console = Console(file=output, width=80, force_terminal=True, color_system=None)
    left = list(lines)
    with ConsoleProgress(console, lambda: [left.pop()] if left else [], num_timesteps) as shown:
        shown.update(gmis)
        text = output.getvalue()
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text).replace("\r", "")


def test_the_panel_of_a_job_shows_what_several_gmis_say():
    gmis = [GmiStatus(gmi, "[/odd]", 3, None, None) for gmi in range(2)]
    assert "GMI 0: [/odd], iteration 3" in panel(gmis)
    assert "GMI" not in panel(gmis[:1])


def _status(*states: str) -> tuple[GmiStatus, ...]:
    return tuple(GmiStatus(gmi, state, 0, None, None) for gmi, state in enumerate(states))


WHY = "compiling: once for each task and size, "


class Clock:
    """Stands still unless a test moves it."""

    now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    stopped = Clock()
    for module in (phases, progress, time_left):
        monkeypatch.setattr(module, "time", stopped)
    return stopped


@pytest.fixture
def compile_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], CompileTime]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return lambda: CompileTime({"env": "ant", "num_envs": 64})


def test_while_it_compiles_a_job_says_why_and_for_how_long(
    clock: Clock, compile_time: Callable[[], CompileTime]
):
    output = io.StringIO()
    with ConsoleProgress(Console(file=output, width=80), list, 10, compile_time()) as shown:
        for states, seconds in (
            (("starting",), 0),
            (("compiling",), 5),
            (("compiling",), 29),
            (("compiling",), 2),
            (("running",), 11),
        ):
            clock.now_s += seconds
            shown.update(_status(*states))
    assert output.getvalue().splitlines() == [
        "starting: loading JAX, building the environments  0:00",
        f"{WHY}up to 3 minutes  0:00",
        f"{WHY}up to 3 minutes  0:31",
        "compiled in 0:42",
    ]
    assert compile_time().last_s == 42


def test_the_next_time_a_job_knows_how_long_it_compiles(
    clock: Clock, compile_time: Callable[[], CompileTime]
):
    compile_time().note(42.0)
    output = io.StringIO()
    shown = ConsoleProgress(Console(file=output, width=300), list, 10, compile_time())
    shown.update(_status("compiling"))
    clock.now_s += 100
    shown.update(_status("compiling"))
    assert output.getvalue().splitlines() == [
        f"{WHY}last time 0:42  0:00",
        f"{WHY}last time 0:42, longer now  1:40",
    ]
    assert CompileTime({"env": "ant", "num_envs": 128}).last_s is None


def test_a_job_without_metrics_says_what_it_does_once_it_runs(
    clock: Clock, compile_time: Callable[[], CompileTime]
):
    output, compiled = io.StringIO(), compile_time()
    console = Console(file=output, width=300)
    with ConsoleProgress(console, list, 0, compiled, "playing 16 episodes") as shown:
        for state in ("starting", "compiling", "running", "running"):
            shown.update(_status(state))
            clock.now_s += 20
    assert output.getvalue().splitlines() == [
        "starting: loading JAX, building the environments  0:00",
        f"{WHY}up to 3 minutes  0:00",
        "compiled in 0:20",
        "playing 16 episodes  0:00",
    ]
    assert compile_time().last_s == 20


def test_an_eta_goes_by_the_latest_iterations_and_not_by_the_first(clock: Clock):
    left, estimates = TimeLeft(), []
    for seconds, steps in ((0, 10), (9, 20), (1, 20), (1, 30), (1, 130), (9, 1030), (60, 7030)):
        clock.now_s += seconds
        left.note(steps)
        estimates.append(left.seconds(10_000))
    assert estimates[:4] == [None] * 4  # Reports are too few; what is noted twice is one.
    assert estimates[4:] == pytest.approx([987.0, 8970 / (1020 / 21), 2970 / (7000 / 70)], rel=0.1)
    clock.now_s += 10
    assert left.seconds(10_000) == pytest.approx((estimates[-1] or 0) - 10)
    assert left.seconds(7030) is None
    left.note(0)  # Started again.
    assert left.seconds(10_000) is None


def test_broken_notes_of_compile_times_are_no_error(
    compile_time: Callable[[], CompileTime], tmp_path: Path
):
    path = tmp_path / "gmijax" / "compile_times.json"
    path.parent.mkdir()
    path.write_text("{")
    assert compile_time().last_s is None
    compile_time().note(2.0)
    assert compile_time().last_s == 2


@pytest.mark.parametrize(
    ("states", "phase"),
    [
        (("waiting", "waiting"), "waiting"),
        (("starting", "waiting"), "starting"),
        (("ready", "starting"), "compiling"),
        (("compiling", "waiting"), "compiling"),
        (("ready", "running"), "running"),
        (("running", "stopping"), "stopping"),
        ((), "running"),
    ],
)
def test_the_phase_of_several_gmis_is_that_of_the_job(states: tuple[str, ...], phase: str):
    output = io.StringIO()
    ConsoleProgress(Console(file=output, width=300), list, 10).update(_status(*states))
    # Without a figure there is nothing to say of a job that runs.
    assert output.getvalue().partition(" ")[0].strip(":") == ("" if phase == "running" else phase)


@pytest.mark.parametrize("is_terminal", [False, True])
def test_a_stop_names_once_what_it_waits_for(is_terminal: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gmijax.control.display.REFRESH_S", 0.0)
    output = io.StringIO()
    console = Console(file=output, width=300, force_terminal=is_terminal)
    with ConsoleProgress(console, list, 10) as shown:
        for state in ("running", "stopping", "stopping", "done"):
            shown.update(_status(state, state))
    assert (
        output.getvalue().count("then saving; a second Ctrl-C ends at once, without saving") == 1
    )


def test_a_stop_names_the_signal_that_asked_for_it():
    signals, output = StopSignals(), io.StringIO()
    signals.handle(signal.SIGTERM)
    asked = GmiStatus(0, "stopping", 3, None, None, signals.name)
    ConsoleProgress(Console(file=output, width=300), list, 10).update((asked,))
    assert "a second SIGTERM ends at once" in output.getvalue()


def test_a_pack_does_not_say_that_programs_of_others_save():
    sweep = build_sweep(["env=ant", "seed=0,1"])
    pack = build_pack(["pack.stop_signal=INT", "seed=0,1"], ["echo", "{seed}"])
    lines = []
    for work in (sweep, pack):
        output = io.StringIO()
        view = SweepView(Console(file=output, width=300), [], work.ranking, work.stopping)
        for _ in range(2):
            view.update("SIGTERM")
        lines.append(output.getvalue())
    saves, ends = (line.removeprefix("stopping: running jobs ").rstrip() for line in lines)
    assert saves == "save and end; a second SIGTERM ends them at once, without saving"
    assert ends == "get SIGINT and may take 25 s to end; a second SIGTERM ends them at once"


def test_figures_of_before_a_restart_are_not_shown_while_it_compiles_again():
    output = io.StringIO()
    shown = ConsoleProgress(Console(file=output, width=300), lambda: [SYNC], 1000)
    for state in ("running", "compiling"):
        shown.update(_status(state))
    assert ["steps/s" in line for line in output.getvalue().splitlines()] == [True, False]
    assert "steps/s" in panel(_status("running"), SYNC)
    assert "steps/s" not in panel(_status("compiling"), SYNC)


def test_the_panel_fits_eighty_columns():
    line = {**SYNC, "env_steps": 12_345_678, "env_steps_per_s": 1_234_567.0, "return": -12345.67}
    text = panel(_status("running"), line, num_timesteps=10**9)
    assert len(text.strip().splitlines()) == 2


@pytest.mark.parametrize("gmis", [1, 2])
@pytest.mark.parametrize("show", [True, "verbose"])
def test_reasons_are_for_those_who_ask(
    gmis: int, show: Show, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = make_plan(PlanConfig(gmis_per_gpu=gmis), ReduceConfig(), 64, machine(0))
    lines = ["a note", "backend share: warning: slow", "physics.impl jax: x"]
    announce(open_console(show=show), RunPaths(tmp_path), plan, "template x", lines)
    text = capsys.readouterr().out
    assert ("one process on the CPU, 64 environments" in text) == (gmis == 1)
    assert ("layout [[0, 1]]" in text) == (gmis == 2)
    assert "  a note" in text
    assert "warning: slow" in text
    for reason in ("backend cpu: ", "strategy ", "physics.impl "):
        assert (reason in text) == (show == "verbose")


def test_a_run_ends_with_what_to_do_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run = RunPaths(tmp_path / "runs" / "a b")
    ending = train_outcome({**SUMMARY, "checkpoint": str(run.checkpoint(10))}, run)
    assert "final return 58.80 (with exploration noise, mean of the latest episodes)" in ending
    assert "checkpoint: runs/a b/checkpoints/000000000010\n" in ending
    print_next(open_console(show=True), *next_steps(run))
    assert capsys.readouterr().out.splitlines()[-1] == "  gmijax play run.dir='runs/a b'"
    monkeypatch.chdir("/")
    assert nearby(run.root) == str(run.root).removeprefix("/")


RATES = ("step_per_s_sim", "step_per_s_inference", "step_per_s_train")
SUMMARY = {
    **{"status": "completed", "env_steps": 10, "wall_s": 1.0, "restarts": [], "eval": None},
    **{"final_return": 58.8, "checkpoint": None, "overflow_steps": {}},
    **dict.fromkeys(RATES),
}


@pytest.mark.parametrize(("deterministic", "how"), [(True, "without"), (False, "with")])
def test_an_evaluation_says_whether_it_was_with_noise(
    deterministic: bool, how: str, tmp_path: Path
):
    run = RunPaths(tmp_path)
    write_json(run.config, {"eval": {"deterministic": deterministic}})
    best = {"env_steps": 5, "return": 8.0, "checkpoint": str(run.checkpoint(5))}
    found = {"last": {"env_steps": 9, "return": 7.5}, "best": best}
    lines = train_outcome({**SUMMARY, "eval": found}, run).splitlines()
    assert f"evaluation: return 7.50 {how} exploration noise, after 9 env steps" in lines
    assert any(line.startswith("  best 8.00: ") for line in lines)


@pytest.mark.parametrize(
    ("iterations", "error", "line"),
    [
        ((20, 25), None, "profile of iterations 20 to 25: profile/a/perfetto_trace.json.gz"),
        (None, None, "profile: none, the command ended before the first iteration of run.profile"),
        ((20, 22), "disk full", "profile: the trace could not be written: disk full"),
    ],
)
def test_a_run_says_what_became_of_its_profile(
    iterations: tuple[int, int] | None,
    error: str | None,
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.chdir(tmp_path)
    run = RunPaths(tmp_path)
    (run.profile / "a").mkdir(parents=True)
    (run.profile / "a" / "perfetto_trace.json.gz").touch()
    profile = {"iterations": iterations, "dir": str(run.profile), "error": error}
    assert line in train_outcome({**SUMMARY, "profile": profile}, run).splitlines()


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
    output = io.StringIO()
    Console(file=output, width=200, markup=False).print(playing.returns_table(returns))
    for name in ("a[/b].py:make", "near[/]", "[red]x"):
        assert name in output.getvalue()
