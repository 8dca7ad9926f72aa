"""When a job is tried again, from where, and when it is not; attempts are faked."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from supervision import gpu, machine, save

from gmijax.cli.compose import compose
from gmijax.control import restarts
from gmijax.control.reduced_plan import with_gpus_left
from gmijax.control.restarts import Attempts, why_not_again
from gmijax.control.run_folder import clear_unfinished, keep_logs
from gmijax.errors import BackendUnavailable, ConfigError, GmiFailed, ReportedError
from gmijax.partition import reduction
from gmijax.runs.folder import META, RunPaths, read_json, write_json
from gmijax.supervise.job_kinds import training_plan
from gmijax.supervise.stop_signals import StopSignals

TRACE = 'Traceback:\n  File "task.py", line {line}, in step\n    x\nValueError: at 0x{address}\n'
Act = Callable[[StopSignals], None]


def error(kind: str = "ValueError", *, iteration: int = 3, line: int = 5) -> GmiFailed:
    reported = ReportedError(kind, "off", TRACE.format(line=line, address=iteration * 7919))
    return GmiFailed(1, f"exit code 1: {kind}: off", iteration=iteration, error=reported)


def killed() -> GmiFailed:
    return GmiFailed(0, "ended by SIGKILL", iteration=3)


class Job:
    """Attempts, at most three without a newer checkpoint; each does what the next act says."""

    def __init__(self, run: RunPaths, monkeypatch: pytest.MonkeyPatch) -> None:
        self.run = run
        self.started_from: list[int | None] = []
        self.acts: Iterator[Act] = iter(())
        self.attempts = Attempts(run, 2, self._launch_at, lambda _: None)
        monkeypatch.setattr(restarts, "run_gmis", lambda _, __, signals: next(self.acts)(signals))

    def go(self, *acts: Act, origin: Path | None = None) -> None:
        self.acts = iter(acts)
        self.attempts.run_to_the_end(origin, lambda _: None)

    def gives_up(self, *acts: Act) -> str:
        """The note of the failure that the job ends with."""
        with pytest.raises(GmiFailed) as caught:
            self.go(*acts)
        return "; ".join(getattr(caught.value, "__notes__", []))

    def events(self) -> list[str]:
        return [json.loads(line)["event"] for line in self.run.events.read_text().splitlines()]

    def dies(self, *saves: int, breaks: int | None = None, why: Exception | None = None) -> Act:
        """An attempt that saves checkpoints and fails."""

        def act(_: StopSignals) -> None:
            for env_steps in saves:
                save(self.run, env_steps)
            if breaks is not None:
                (self.run.checkpoint(breaks) / META).write_text("{")
            raise why or killed()

        return act

    def _launch_at(self, checkpoint: Path | None, attempt: int) -> Any:
        self.started_from.append(None if checkpoint is None else int(checkpoint.name))
        return attempt


def fine(_: StopSignals) -> None:
    return None


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    return RunPaths(tmp_path)


@pytest.fixture
def job(run: RunPaths, monkeypatch: pytest.MonkeyPatch) -> Job:
    return Job(run, monkeypatch)


def test_a_killed_gmi_starts_the_job_again_from_its_newest_checkpoint(job: Job, run: RunPaths):
    job.go(job.dies(), job.dies(100, 200), fine)
    assert job.started_from == [None, None, 200]
    assert [(r.gmi, r.checkpoint) for r in job.attempts.restarts] == [
        (0, None),
        (0, str(run.checkpoint(200))),
    ]
    assert job.events() == ["start", "fault", "start", "fault", "start", "end"]


def test_a_newer_checkpoint_sets_the_count_back(job: Job):
    dies = job.dies()
    job.go(dies, dies, job.dies(100), dies, job.dies(200), fine)
    assert len(job.attempts.restarts) == 5


def test_without_a_newer_checkpoint_the_count_ends(job: Job):
    assert "run.max_restarts=2" in job.gives_up(*[job.dies()] * 4)
    assert len(job.attempts.restarts) == 2
    assert job.events()[-2:] == ["fault", "gave_up"]


def test_an_older_checkpoint_does_not_set_the_count_back(job: Job, run: RunPaths):
    save(run, 100)
    job.gives_up(job.dies(200), job.dies(), job.dies(breaks=200), fine)
    assert job.started_from == [None, 200, 200]


def test_a_job_whose_checkpoints_are_all_broken_starts_at_its_origin(job: Job, run: RunPaths):
    other = save(RunPaths(run.root / "other"), 50)
    job.go(job.dies(100), job.dies(breaks=100), fine, origin=other)
    assert job.started_from == [50, 100, 50]


def test_a_backend_that_cannot_start_again_is_named_with_the_fault(job: Job):
    gone = BackendUnavailable("the daemon does not answer")
    message = job.gives_up(job.dies(), job.dies(why=gone))
    assert "cannot start again: the daemon does not answer" in message

    def launch_at(checkpoint: Path | None, attempt: int) -> Any:
        raise ConfigError("GPUs [1] of the job are gone")

    job.attempts.launch_at = launch_at
    assert "cannot start again: GPUs [1] of the job are gone" in job.gives_up()


@pytest.mark.parametrize("why", [BackendUnavailable("no daemon"), ConfigError("env.name=antt")])
def test_bad_input_at_the_first_attempt_is_no_fault(job: Job, why: Exception):
    with pytest.raises(type(why)):
        job.go(job.dies(why=why), fine)


@pytest.mark.parametrize("kind", ["NonFiniteError", "ParameterMismatch", "SelfCheckFailed"])
def test_what_would_come_again_ends_the_job(job: Job, kind: str):
    job.gives_up(job.dies(why=error(kind)), fine)
    assert not job.attempts.restarts


def test_a_full_disk_ends_the_job(job: Job):
    reported = ReportedError("OSError", "[Errno 28] No space left on device: 'metrics.jsonl'", "")
    full = GmiFailed(0, "exit code 1", iteration=3, error=reported)
    assert "the disk is full" in job.gives_up(job.dies(why=full), fine)


def test_the_same_error_at_the_same_iteration_ends_the_job(job: Job):
    assert "same iteration (3) twice" in job.gives_up(*[job.dies(why=error())] * 2, fine)
    assert len(job.attempts.restarts) == 1
    for other in (error(iteration=4), error(line=6), error("KeyError"), killed()):
        assert why_not_again(other, error()) is None


def test_a_process_that_ends_itself_at_the_same_iteration_twice_ends_the_job(job: Job):
    def ended(code: int, iteration: int = 0) -> GmiFailed:
        return GmiFailed(0, f"exit code {code}", iteration=iteration, exit_code=code)

    message = job.gives_up(*[job.dies(why=ended(1))] * 2, fine)
    assert "exit code 1 at the same iteration (0) twice" in message
    assert len(job.attempts.restarts) == 1
    for other in (ended(2), ended(1, iteration=4), ended(-6), error(iteration=0)):
        assert why_not_again(other, ended(1)) is None
    assert why_not_again(ended(-6), ended(-6)) is None
    assert why_not_again(ended(1), None) is None


def test_a_failure_while_the_job_stops_is_not_tried_again(job: Job):
    def stop_and_fail(signals: StopSignals) -> None:
        signals.handle(signal.SIGTERM)
        raise killed()

    job.gives_up(stop_and_fail, fine)
    assert job.started_from == [None]


def test_logs_of_a_failed_attempt_are_kept(run: RunPaths):
    write_json(run.gmi(0).error, {"type": "E"})
    keep_logs(run)
    write_json(run.gmi(0).error, {"type": "F"})
    keep_logs(run)
    kept = [read_json(run.gmi(0).root / f"attempt_{n}" / "error.json")["type"] for n in (0, 1)]
    assert kept == ["E", "F"]
    assert not run.gmi(0).error.exists()


def test_logs_of_an_earlier_command_are_kept(job: Job):
    gmi = job.run.gmi(0).root
    (gmi / "attempt_0").mkdir(parents=True)
    write_json(gmi / "attempt_0" / "error.json", {"type": "E"})
    write_json(job.run.gmi(0).error, {"type": "F"})
    job.go(job.dies(100), fine)
    kept = [read_json(gmi / f"attempt_{n}" / "error.json")["type"] for n in (0, 1)]
    assert kept == ["E", "F"]


def test_what_came_after_the_checkpoint_is_dropped(run: RunPaths):
    lines = [{"env_steps": steps} for steps in (50, 100, 150)]
    run.metrics.write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"env_st')
    checkpoint = save(run, 100)
    write_json(run.gmi(0).result, {"status": "completed", "env_steps": 150})
    (run.checkpoints / ".000000000150.partial" / "learner").mkdir(parents=True)
    clear_unfinished(run, checkpoint)
    assert [path.name for path in run.checkpoints.iterdir()] == [checkpoint.name]
    assert not run.gmi(0).result.exists()
    assert [json.loads(line)["env_steps"] for line in run.metrics.read_text().splitlines()] == [
        50,
        100,
    ]


def test_only_the_same_signal_a_second_later_is_impatience(monkeypatch: pytest.MonkeyPatch):
    now_s = [100.0]
    monkeypatch.setattr("gmijax.supervise.stop_signals.time.monotonic", lambda: now_s[0])
    signals = StopSignals()
    signals.handle(signal.SIGINT)
    assert (signals.requests, signals.are_urgent) == (1, False)
    for later_s, number in ((0, signal.SIGINT), (30, signal.SIGTERM), (0.1, signal.SIGTERM)):
        now_s[0] += later_s
        signals.handle(number)
    assert (signals.requests, signals.are_urgent) == (1, True)
    now_s[0] += 1.5
    signals.handle(signal.SIGTERM)
    assert signals.requests == 2


def test_half_written_files_of_killed_processes_go_and_all_others_stay(run: RunPaths):
    half = (
        run.root / ".summary.json.12-345",
        run.gmi(1).root / ".error.json.12-345",
        run.gmi(1).root / "attempt_0" / ".error.json.67-8",
    )
    whole = (run.lock, run.summary, run.gmi(1).root / "attempt_0" / "error.json")
    for path in (*half, *whole):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    clear_unfinished(run, None)
    assert not any(path.exists() for path in half)
    assert all(path.exists() for path in whole)


FOUR = machine(4)
LEFT = machine(0, gpus=(gpu(0), gpu(2), gpu(3)), driver_version="580.159.03")


@pytest.mark.parametrize(
    ("overrides", "strategies", "layout", "devices"),
    [
        (
            ("plan.gpus=4", "plan.gmis_per_gpu=2"),
            *(("mrr", "mrr"), "[[0,1],[2,3],[4,5]]", [0, 0, 2, 2, 3, 3]),
        ),
        # Algorithm 1 decides again for what is left.
        (("plan.gpus=2", "plan.gmis_per_gpu=2"), ("mrr", "mpr"), "[[0,1]]", [0, 0]),
        # An uneven layout loses its row.
        (
            ("plan.layout=[[0],[1,2],[3,4,5]]",),
            *(("har", "har"), "[[0],[1,2,3]]", [0, 2, 2, 2]),
        ),
    ],
)
def test_a_lost_gpu_shrinks_the_plan(
    monkeypatch: pytest.MonkeyPatch,
    overrides: tuple[str, ...],
    strategies: tuple[str, str],
    layout: str,
    devices: list[int],
):
    monkeypatch.setattr(reduction, "is_installed", lambda *_: True)
    config = compose(
        *("env=ant", "plan.backend=share", "num_envs=64", "run.elastic=true"),
        *("reduce.strategy=paper", *overrides),
    )
    plan = training_plan(config, FOUR)
    assert with_gpus_left(config, plan, FOUR) == (config, plan, ())
    config, shrunk, notes = with_gpus_left(config, plan, LEFT)
    assert [allocation.device for allocation in shrunk.allocations] == [
        gpu(index).uuid for index in devices
    ]
    assert (plan.strategy, shrunk.strategy) == strategies
    assert (str(shrunk.layout), shrunk.num_envs_per_gmi) == (layout, 64)
    assert notes[0].startswith("GPUs [1] of the job are gone: continuing with ")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ("plan.gpus=2",),
            r"GPUs \[1\] .* gone; run\.elastic=true would continue with the 1 left",
        ),
        (("run.elastic=true", "plan.gpus=[1]"), r"GPUs \[0\] .* gone, and no other one is left"),
    ],
)
def test_jobs_that_cannot_go_on_are_refused(overrides: tuple[str, ...], message: str):
    config = compose("env=ant", "plan.backend=share", *overrides)
    with pytest.raises(ConfigError, match=message):
        with_gpus_left(config, training_plan(config, FOUR), LEFT)
