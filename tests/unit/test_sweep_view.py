"""What is shown of a sweep: a live table, whose errors end it alone, TensorBoard, rates."""

from __future__ import annotations

import dataclasses
import io
import struct
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from tensorboardX.proto import event_pb2, plugin_hparams_pb2

from gmijax.cli.compose import compose
from gmijax.config.sweep import SweepConfig
from gmijax.control import display
from gmijax.control.console import open_console
from gmijax.errors import printable
from gmijax.runs.folder import RunPaths
from gmijax.runs.held import OpenFolder
from gmijax.sweeps.hparams import write_hparams
from gmijax.sweeps.jobs import Job, jobs_of
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.report import JobsReport
from gmijax.sweeps.view import SweepView

SWEEP = SweepConfig(objective="return")


def running_jobs() -> list[Job]:
    jobs = list(jobs_of([compose(f"seed={seed}", "num_timesteps=1000") for seed in range(4)]))
    now_s = time.monotonic()
    for job, steps in zip(jobs, (500, 250, 1000, 0), strict=True):
        progress = job.progress
        for at, value, full in ((100, 9.0, 0), (steps, 2.5, 1)) if steps else ():
            line = {"env_steps": at, "env_steps_per_s": 50.0, "return": value}
            line |= {"window/return": value + 1.0, "window/episodes": at, "window/full": full}
            progress.take(line, SWEEP)
            progress.updated_s = now_s - 1790.0
        if steps:
            progress.state, progress.started_s = "running", now_s - 1800.0
            progress.first_started_s = progress.started_s
            progress.slot = f"GPU 3 slot {job.number}"
    done = jobs[2].progress
    done.state, done.ended_s, done.slot, done.env_steps_per_s = "completed", now_s, "", 0.0
    jobs[3].progress.error = "again, alone on its GPU, after CUDA_ERROR_[/x]"
    return jobs


class Terminal(io.StringIO):
    """A terminal that may be closed."""

    is_closed_by_user = False

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        if self.is_closed_by_user:
            raise BrokenPipeError
        return super().write(text)


def view_on(stream: Any, jobs: list[Job]) -> SweepView:
    console = Console(
        file=stream, force_terminal=stream.isatty(), width=160, markup=False, color_system=None
    )
    return SweepView(console, jobs, SWEEP, "{}")


def test_the_table_says_of_each_job_where_and_how_far_it_is() -> None:
    terminal = Terminal()
    with view_on(terminal, running_jobs()) as view:
        view.update()
        shown = terminal.getvalue()
    rows = rows_of(shown)
    assert rows["job"] == "job overrides GPU and slot progress steps/s return ranked by state"
    assert rows["0"].endswith("50% 50 2.5 3.5 running")
    assert "seed=0 GPU 3 slot 0" in rows["0"]
    assert rows["1"].endswith("25% 50 2.5 3.5 running")
    assert rows["2"].endswith("100% 2.5 3.5 completed")
    assert "waiting: again, alone on its GPU, after CUDA_ERROR_[/x]" in rows["3"]
    assert "2 running, 1 waiting, 1 completed; 100 steps/s, 2.0 runs/h" in shown


def rows_of(shown: str) -> dict[str, str]:
    """Rows of the last table by their first words."""
    table = shown[shown.rindex("job ") :]
    lines = [printable(line).split() for line in table.splitlines()]
    return {words[0]: " ".join(words) for words in reversed(lines) if words}


def test_a_job_shows_how_long_it_starts_and_an_eta_once_its_rate_is_steady(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(display, "REFRESH_S", 0.0)
    terminal, now_s = Terminal(), [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    (job,) = jobs_of([compose("num_timesteps=1000")])
    shown = []
    with view_on(terminal, [job]) as view:
        job.progress.begin("", None)
        for seconds, steps in ((42, 0), (1, 100), (20, 110), (2, 210), (2, 310), (2, 410)):
            now_s[0] += seconds
            if steps:
                job.progress.report({"env_steps": steps, "env_steps_per_s": 50.0}, SWEEP)
            view.update()
            shown.append(rows_of(terminal.getvalue())["0"])
    assert shown[0].endswith(" 0% starting 0:42")
    assert [row.split()[-2:] for row in shown[1:4]] == [["50", "running"]] * 3
    # 210 steps in 24 s, and 590 are left; by the rate of the last report it would be 0:12.
    assert [row.split()[-2] for row in shown[4:]] == ["1:19", "0:49"]


def test_without_a_terminal_every_change_is_a_line() -> None:
    output, jobs = io.StringIO(), running_jobs()
    with view_on(output, jobs) as view:
        view.update()
        view.update()
        jobs[0].progress.state, jobs[0].progress.error = "failed", "GMI 0 failed: NonFiniteError"
    lines = output.getvalue().splitlines()
    assert lines[:2] == [f"job {n} seed={n}: running on GPU 3 slot {n}" for n in range(2)]
    assert lines[2].startswith("job 2 seed=2: completed after 1800 s, return 3.5; 2 running")
    assert lines[3:] == ["job 0 seed=0: failed: GMI 0 failed: NonFiniteError"]


@pytest.mark.parametrize("state", ["completed", "pruned"])
def test_what_an_earlier_command_has_done_is_no_news(state: Any) -> None:
    output, (before, now) = io.StringIO(), jobs_of([compose(), compose("seed=1")])
    before.progress.state = state
    before.progress.take_summary({"wall_s": 7.0})
    with view_on(output, [before, now]) as view:
        view.update()
        now.progress.begin("", None)
        now.progress.state = state
        view.update()
    (line,) = output.getvalue().splitlines()
    assert line.startswith(f"job 1 seed=1: {state} after 0 s; 2 {state}")


def test_a_long_command_is_there_once() -> None:
    output, jobs = io.StringIO(), running_jobs()[:2]
    command = "python train.py --seed 7 " + "--more options " * 20
    jobs[0] = dataclasses.replace(jobs[0], overrides={"command": command})
    with view_on(output, jobs) as view:
        view.update()
        for job in jobs:
            job.progress.state, job.progress.error = "failed", "exit code 3"
    assert output.getvalue().count("--seed 7") == 1
    not_started = io.StringIO()
    with view_on(not_started, jobs):
        pass
    assert not_started.getvalue().count("--seed 7") == 1
    assert output.getvalue().endswith(
        "job 0: failed: exit code 3\njob 1 seed=1: failed: exit code 3\n"
    )


def test_a_value_of_a_window_that_is_not_full_is_marked_where_it_is_shown() -> None:
    output, (job,) = io.StringIO(), jobs_of([compose()])
    early = {"return": 9.0, "window/return": 8.0, "window/episodes": 12, "window/full": 0}
    job.progress.take({"env_steps": 100, **early}, SWEEP)
    terminal = Terminal()
    with view_on(terminal, [job]) as view:
        job.progress.state = "running"
        view.update()
    assert "9 8 (early) " in " ".join(terminal.getvalue().split())
    job.progress.state = "interrupted"
    interrupted = io.StringIO()
    with view_on(interrupted, [job]) as view:
        view.update()
    assert "s, return 8 so far; " in interrupted.getvalue()
    job.progress.begin("", None)
    job.progress.state = "completed"
    with view_on(output, [job]) as view:
        view.update()
    # Nothing is overridden: there is nothing to say of it.
    assert output.getvalue().startswith("job 0: completed after ")
    assert "s, return 8 (12 episodes, too few to compare); " in output.getvalue()


@pytest.mark.parametrize("what", ["a terminal that is closed", "a row that cannot be made"])
def test_an_error_of_the_view_ends_the_view_alone(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(display, "REFRESH_S", 0.0)
    terminal, jobs = Terminal(), running_jobs()
    monkeypatch.setattr(sys, "stdout", terminal)
    with SweepView(open_console(show=True), jobs, SWEEP, "{}") as view:
        view.update()
        if what == "a terminal that is closed":
            terminal.is_closed_by_user = True
        else:
            jobs[0].progress.state = "nowhere"  # type: ignore[assignment]
        view.update()
        before = terminal.getvalue()
        assert "seed=0" in before
        view.update()
    assert terminal.getvalue() == before
    if what == "a row that cannot be made":
        assert before.count("progress is no longer shown: ValueError") == 1


def test_overrides_and_value_of_a_job_are_there_for_the_hparams_tab(tmp_path: Path) -> None:
    chosen = {"algo.learning_rate": "1e-4", "env": "ant", "algo.clip_value_loss": "true"}
    job, run = Job(0, chosen, compose()), RunPaths(tmp_path)
    write_hparams(job, run, "return")
    assert not run.tensorboard.exists()  # Without a value there is nothing to compare.
    job.progress.value, job.progress.env_steps = 7.5, 640
    write_hparams(job, run, "return")
    (path,) = run.tensorboard.iterdir()
    values = [(event.step, value) for event in events(path) for value in event.summary.value]
    (scalar,) = [value for step, value in values if value.tag == "hparam/return" and step == 640]
    assert scalar.simple_value == 7.5
    contents = {v.tag.rpartition("/")[2]: v.metadata.plugin_data.content for _, v in values}
    plugin_data = vars(plugin_hparams_pb2)["HParamsPluginData"]
    started = plugin_data.FromString(contents["session_start_info"]).session_start_info.hparams
    assert started["algo.learning_rate"].number_value == 1e-4
    assert started["env"].string_value == "ant"
    assert started["algo.clip_value_loss"].bool_value is True
    experiment = plugin_data.FromString(contents["experiment"]).experiment
    assert [info.name.tag for info in experiment.metric_infos] == ["hparam/return"]
    assert plugin_data.FromString(contents["session_end_info"]).HasField("session_end_info")


def test_a_value_that_cannot_be_compared_has_a_tag_of_its_own(tmp_path: Path) -> None:
    job, run = Job(0, {"seed": "0"}, compose()), RunPaths(tmp_path)
    job.progress.value, job.progress.is_full = -6.3, False
    write_hparams(job, run, "return")
    (path,) = run.tensorboard.iterdir()
    tags = {value.tag for event in events(path) for value in event.summary.value}
    assert "hparam/return_window_not_full" in tags
    assert "hparam/return" not in tags


def events(path: Path) -> list[Any]:
    """The events of a file of records: length, its checksum, content, its checksum."""
    data, found = path.read_bytes(), []
    while data:
        (length,) = struct.unpack("<Q", data[:8])
        found.append(vars(event_pb2)["Event"].FromString(data[12 : 12 + length]))
        data = data[16 + length :]
    return found


def test_the_table_hides_nothing_of_an_override() -> None:
    """Without GPUs it has no column of slots, and names the keys without their groups."""
    overrides = ("algo.learning_rate=0.00012345", "env.settings.goal_height_m=0.75")
    jobs = list(jobs_of([compose("num_timesteps=1000", *overrides), compose()]))
    jobs[0].progress.state = "running"
    view = SweepView(open_console(show=False), jobs, SWEEP, "{}")
    text = {}
    for width in (80, 120):
        output = io.StringIO()
        Console(file=output, width=width).print(view._table())
        text[width] = output.getvalue()
    assert "…" not in text[80]
    assert "slot" not in text[80]
    assert "starting" in text[80]
    for part in ("learning_rate=0.00012345", "goal_height_m=0.75"):
        assert part in text[120]
    assert "algo." not in text[120]
    assert view.line() == "1 running, 1 waiting"


def test_throughput_is_of_the_jobs_that_a_command_has_run(tmp_path: Path) -> None:
    jobs = running_jobs()
    jobs[3].progress.state, jobs[3].progress.error = "completed", None  # By an earlier command.
    for job in jobs[:2]:
        job.progress.state, job.progress.ended_s = "completed", jobs[2].progress.ended_s
    whole = JobsReport(jobs, SWEEP, dict, SweepPaths(tmp_path), OpenFolder(tmp_path, "x"), 0.0)
    assert whole.end("completed") is None
    report = whole.data
    assert report["trainings_per_hour"] == pytest.approx(3 * 2.0, rel=1e-3)
    rows = report["jobs"]
    assert [row["first_update_s"] for row in rows] == [10.0, 10.0, 10.0, None]
    assert [row["start_s"] for row in rows] == [0.0, 0.0, 0.0, None]
    assert rows[0]["wall_s"] == 1800.0
    assert rows[3]["wall_s"] == 0.0


def test_throughput_counts_the_time_of_attempts_that_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now_s=50.0, monotonic=lambda: clock.now_s)
    monkeypatch.setattr("gmijax.sweeps.progress.time", clock)
    (job,) = jobs_of([compose()])
    for _ in range(3):  # Each takes an hour; the last one is complete.
        job.progress.begin("GPU 0 slot 0", None)
        clock.now_s += 3600.0
        job.progress.ended_s = clock.now_s
    job.progress.state = "completed"
    whole = JobsReport([job], SWEEP, dict, SweepPaths(tmp_path), OpenFolder(tmp_path, "x"), 0.0)
    assert whole.end("completed") is None
    assert whole.data["trainings_per_hour"] == pytest.approx(1 / 3)
    (row,) = whole.data["jobs"]
    assert (row["start_s"], row["wall_s"], row["attempts"]) == (7200.0, 3600.0, 3)
