"""When a job is tried again, from where, and when it is not; attempts are faked."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from supervision import gpu, machine

from gmijax.cli.compose import compose
from gmijax.control import restarts
from gmijax.control.restarts import (
    Attempts,
    clear_unfinished,
    keep_logs,
    why_not_again,
    with_gpus_left,
)
from gmijax.errors import BackendUnavailable, ConfigError, GmiFailed, ReportedError
from gmijax.runs.folder import META, RunPaths, read_json, write_json
from gmijax.runs.resume import CheckpointMeta
from gmijax.supervise.kinds import training_plan
from gmijax.supervise.launcher import StopSignals

TRACE = 'Traceback:\n  File "task.py", line {line}, in step\n    x\nValueError: at 0x{address}\n'


def error(kind: str = "ValueError", *, iteration: int = 3, line: int = 5) -> GmiFailed:
    said = ReportedError(kind, "off", TRACE.format(line=line, address=iteration * 7919))
    return GmiFailed(1, f"exit code 1: {kind}: off", iteration=iteration, error=said)


def killed() -> GmiFailed:
    return GmiFailed(0, "ended by SIGKILL", iteration=3)


def save(run: RunPaths, env_steps: int) -> Path:
    meta = CheckpointMeta("ant", "ppo", env_steps, 1, 8, ((8,), (8,)), "jax")
    write_json(run.checkpoint(env_steps) / META, meta.to_dict())
    return run.checkpoint(env_steps)


class Job:
    """Attempts of which each does what the next of `acts` does."""

    def __init__(self, run: RunPaths, monkeypatch: pytest.MonkeyPatch, max_restarts: int) -> None:
        self.run = run
        self.started_from: list[Path | None] = []
        self.said: list[str] = []
        self.acts: Iterator[Callable[[StopSignals], None]] = iter(())
        self.attempts = Attempts(run, max_restarts, self._launch_at, self.said.append)
        monkeypatch.setattr(restarts, "run_gmis", self._run_gmis)

    def go(self, *acts: Callable[[StopSignals], None]) -> None:
        self.acts = iter(acts)
        self.attempts.run_to_the_end(None, lambda _: None)

    def events(self) -> list[str]:
        return [json.loads(line)["event"] for line in self.run.events.read_text().splitlines()]

    def _launch_at(self, checkpoint: Path | None, attempt: int) -> Any:
        self.started_from.append(checkpoint)
        return attempt

    def _run_gmis(self, launch: Any, on_tick: Any, signals: StopSignals) -> None:
        next(self.acts)(signals)


def fail(error: Exception) -> Callable[[StopSignals], None]:
    def act(_: StopSignals) -> None:
        raise error

    return act


def fine(_: StopSignals) -> None:
    return None


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    return RunPaths(tmp_path)


@pytest.fixture
def job(run: RunPaths, monkeypatch: pytest.MonkeyPatch) -> Job:
    return Job(run, monkeypatch, max_restarts=2)


def test_a_killed_gmi_starts_the_job_again_from_its_newest_checkpoint(job: Job, run: RunPaths):
    def save_and_fail(_: StopSignals) -> None:
        save(run, 100)
        save(run, 200)
        raise killed()

    job.go(fail(killed()), save_and_fail, fine)
    assert job.started_from == [None, None, run.checkpoint(200)]
    assert [(r.gmi, r.checkpoint) for r in job.attempts.restarts] == [
        (0, None),
        (0, str(run.checkpoint(200))),
    ]
    assert job.events() == ["start", "fault", "start", "fault", "start", "end"]


def test_a_newer_checkpoint_sets_the_count_back(job: Job, run: RunPaths):
    def save_and_fail(env_steps: int) -> Callable[[StopSignals], None]:
        def act(_: StopSignals) -> None:
            save(run, env_steps)
            raise killed()

        return act

    ends = [killed() for _ in range(3)]
    job.go(
        fail(ends[0]), fail(ends[1]), save_and_fail(100), fail(ends[2]), save_and_fail(200), fine
    )
    assert len(job.attempts.restarts) == 5


def test_without_a_newer_checkpoint_the_count_ends(job: Job):
    with pytest.raises(GmiFailed) as caught:
        job.go(*(fail(killed()) for _ in range(4)))
    assert len(job.attempts.restarts) == 2
    assert "run.max_restarts=2" in caught.value.__notes__[0]
    assert job.events()[-2:] == ["fault", "gave_up"]


def test_an_older_checkpoint_does_not_set_the_count_back(job: Job, run: RunPaths):
    def break_and_fail(_: StopSignals) -> None:
        (run.checkpoint(200) / META).write_text("{")
        raise killed()

    save(run, 100)
    dies = fail(killed())

    def save_and_fail(_: StopSignals) -> None:
        save(run, 200)
        raise killed()

    with pytest.raises(GmiFailed):
        job.go(save_and_fail, dies, break_and_fail, fine)
    assert len(job.attempts.restarts) == 2
    assert job.started_from == [None, run.checkpoint(200), run.checkpoint(200)]


def test_a_job_whose_checkpoints_are_all_broken_starts_at_its_origin(job: Job, run: RunPaths):
    other = save(RunPaths(run.root / "other"), 50)

    def save_and_fail(_: StopSignals) -> None:
        save(run, 100)
        raise killed()

    def break_and_fail(_: StopSignals) -> None:
        (run.checkpoint(100) / META).write_text("{")
        raise killed()

    job.acts = iter((save_and_fail, break_and_fail, fine))
    job.attempts.run_to_the_end(other, lambda _: None)
    assert job.started_from == [other, run.checkpoint(100), other]


def test_a_backend_that_cannot_be_had_again_is_told_with_the_fault(job: Job):
    with pytest.raises(GmiFailed, match="GMI 0 failed: ended by SIGKILL") as caught:
        job.go(fail(killed()), fail(BackendUnavailable("the daemon does not answer")))
    assert "cannot start again: the daemon does not answer" in caught.value.__notes__


def test_a_backend_that_cannot_be_had_at_all_is_bad_input(job: Job):
    with pytest.raises(BackendUnavailable):
        job.go(fail(BackendUnavailable("the daemon does not answer")))


@pytest.mark.parametrize("kind", ["NonFiniteError", "ParameterMismatch", "SelfCheckFailed"])
def test_what_would_come_again_ends_the_job(job: Job, kind: str):
    with pytest.raises(GmiFailed):
        job.go(fail(error(kind)), fine)
    assert not job.attempts.restarts


def test_bad_input_ends_the_job(job: Job):
    with pytest.raises(ConfigError):
        job.go(fail(ConfigError("env.name=antt")), fine)


def test_the_same_error_at_the_same_iteration_ends_the_job(job: Job):
    with pytest.raises(GmiFailed) as caught:
        job.go(fail(error()), fail(error()), fine)
    assert len(job.attempts.restarts) == 1
    assert "same iteration (3) twice" in caught.value.__notes__[0]


@pytest.mark.parametrize("other", [error(iteration=4), error(line=6), error("KeyError"), killed()])
def test_another_error_is_tried_again(other: GmiFailed):
    assert why_not_again(other, error()) is None


def test_a_failure_while_the_job_stops_is_not_tried_again(job: Job):
    def stop_and_fail(signals: StopSignals) -> None:
        signals.handle(signal.SIGTERM)
        raise killed()

    with pytest.raises(GmiFailed):
        job.go(stop_and_fail, fine)
    assert job.started_from == [None]


def test_a_machine_that_cannot_go_on_is_told_with_the_fault(job: Job):
    def launch_at(checkpoint: Path | None, attempt: int) -> Any:
        if attempt:
            raise ConfigError("GPUs [1] of the job are gone")
        return attempt

    job.attempts.launch_at = launch_at
    with pytest.raises(GmiFailed, match="GMI 0 failed: ended by SIGKILL") as caught:
        job.go(fail(killed()))
    assert "cannot start again: GPUs [1] of the job are gone" in caught.value.__notes__


def test_logs_of_a_failed_attempt_are_kept(run: RunPaths):
    write_json(run.gmi(0).error, {"type": "E"})
    keep_logs(run, 0)
    write_json(run.gmi(0).error, {"type": "F"})
    keep_logs(run, 1)
    kept = [read_json(run.gmi(0).root / f"attempt_{n}" / "error.json")["type"] for n in (0, 1)]
    assert kept == ["E", "F"]
    assert not run.gmi(0).error.exists()


def test_what_came_after_the_checkpoint_is_dropped(run: RunPaths):
    lines = [{"env_steps": steps} for steps in (50, 100, 150)]
    run.metrics.write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"env_st')
    checkpoint = save(run, 100)
    (run.checkpoints / ".000000000150.partial" / "learner").mkdir(parents=True)
    clear_unfinished(run, checkpoint)
    assert [path.name for path in run.checkpoints.iterdir()] == [checkpoint.name]
    assert [json.loads(line)["env_steps"] for line in run.metrics.read_text().splitlines()] == [
        50,
        100,
    ]


def test_only_the_same_signal_a_second_later_is_impatience(monkeypatch: pytest.MonkeyPatch):
    now_s = [100.0]
    monkeypatch.setattr("gmijax.supervise.launcher.time.monotonic", lambda: now_s[0])
    asked: list[float] = []
    signals = StopSignals()
    signals.handle(signal.SIGUSR1)
    signals.forward_to(lambda: asked.append(now_s[0]))
    assert asked == [100.0]
    for later_s, number in ((0, signal.SIGUSR1), (30, signal.SIGTERM), (0.1, signal.SIGTERM)):
        now_s[0] += later_s
        signals.handle(number)
    assert asked == [100.0]
    now_s[0] += 1.5
    signals.handle(signal.SIGTERM)
    assert asked == [100.0, now_s[0]]


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


def test_a_job_that_has_its_gpus_stays_as_it_is():
    config = compose("env=ant", "plan.gpus=2", "plan.backend=share")
    plan = training_plan(config, FOUR)
    assert with_gpus_left(config, plan, FOUR) == (config, plan, ())


def test_a_lost_gpu_shrinks_the_plan():
    config = compose(
        *("env=ant", "plan.gpus=4", "plan.gmis_per_gpu=2", "plan.backend=share", "num_envs=64"),
        *("run.elastic=true", "reduce.intra=host"),
    )
    plan = training_plan(config, FOUR)
    config, shrunk, notes = with_gpus_left(config, plan, LEFT)
    assert [share.device for share in shrunk.slices] == [
        gpu(index).uuid for index in (0, 0, 2, 2, 3, 3)
    ]
    assert (shrunk.num_envs_per_gmi, shrunk.strategy) == (64, "mrr")
    assert notes[0].startswith("GPUs [1] of the job are gone: going on with 3")


def test_algorithm_1_decides_again_for_what_is_left():
    config = compose(
        *("env=ant", "plan.gpus=2", "plan.gmis_per_gpu=2", "plan.backend=share"),
        *("run.elastic=true", "reduce.intra=host"),
    )
    plan = training_plan(config, FOUR)
    _, shrunk, _ = with_gpus_left(config, plan, LEFT)
    assert (plan.strategy, shrunk.strategy) == ("mrr", "mpr")


def test_an_uneven_layout_loses_its_row():
    config = compose(
        *("env=ant", "plan.layout=[[0],[1,2],[3,4,5]]", "plan.backend=share", "run.elastic=true")
    )
    plan = training_plan(config, FOUR)
    _, shrunk, _ = with_gpus_left(config, plan, LEFT)
    assert str(shrunk.layout) == "[[0],[1,2,3]]"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["run.elastic=false"], r"GPUs \[1\] of the job are gone; run\.elastic=true would go on"),
        (["run.elastic=true", "plan.gpus=[1]"], "gone, and no other one is left"),
    ],
)
def test_what_cannot_go_on_is_told(overrides: list[str], message: str):
    config = compose("env=ant", "plan.gpus=2", "plan.backend=share", *overrides)
    plan = training_plan(config, FOUR)
    lost = [0] if "plan.gpus=[1]" in overrides else [1]
    assert lost
    with pytest.raises(ConfigError, match=message.replace(r"\[1\]", rf"\[{lost[0]}\]")):
        with_gpus_left(config, plan, LEFT)
