"""Jobs from Optuna: what is drawn, what is tried again, what is ended early."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import optuna
import pytest
from optuna.storages.journal import JournalFileBackend

from gmijax.cli.compose import compose
from gmijax.cli.grid import build_sweep
from gmijax.config import PpoConfig
from gmijax.errors import ConfigError
from gmijax.sweeps.jobs import Job, jobs_of
from gmijax.sweeps.progress import State
from gmijax.sweeps.study import OptunaStudy

MESSAGES: list[str] = []


def study(folder: Path, *overrides: str) -> OptunaStudy:
    request = build_sweep(overrides)
    journal = folder / "study.log"
    return OptunaStudy(request.settings, request.space, request.make_job, journal, MESSAGES.append)


TOY = ("sweep.sampler=tpe", "algo.learning_rate=tag(log,interval(1e-5,1e-2))", "sweep.trials=8")


def toy_objective(job: Job) -> float:
    """Best at a learning rate of 4e-3 and an entropy cost of 2e-3."""
    algo = job.config.algo
    assert isinstance(algo, PpoConfig)
    far = abs(np.log(algo.learning_rate) - np.log(4e-3))
    return -far - 300.0 * abs(algo.entropy_cost - 2e-3)


def end(job: Job, state: State, value: float | None = None) -> Job:
    job.progress.state, job.progress.value = state, value
    return job


def test_eight_trials_of_tpe_find_better_than_the_default(tmp_path: Path) -> None:
    trials = study(tmp_path, *TOY, "algo.entropy_cost=interval(0,1e-2)")
    values = []
    while job := trials.next():
        values.append(toy_objective(job))
        trials.tell(end(job, "completed", values[-1]))
    assert len(values) == 8
    assert max(values) > toy_objective(jobs_of([compose("algo.entropy_cost=1e-2")])[0])


def test_values_that_are_not_allowed_together_are_left_out_and_the_others_go_on(
    tmp_path: Path,
) -> None:
    lists = ("num_envs=8,64", "algo.num_minibatches=128,1024")
    drawn = (*lists, "sweep.sampler=random", "sweep.trials=12")
    trials = study(tmp_path, *drawn)
    MESSAGES.clear()
    jobs = []
    while job := trials.next():
        jobs.append(job.number)
        trials.tell(end(job, "completed", 1.0))
    assert 0 < len(jobs) < 12
    assert len(MESSAGES) == 12 - len(jobs)
    assert all("do not divide into algo.num_minibatches=1024" in line for line in MESSAGES)
    again = study(tmp_path, *drawn)
    assert [job.number for job in again.earlier()] == jobs
    assert again.next() is None


def test_between_the_ends_of_whole_numbers_nothing_is_asked_before(tmp_path: Path) -> None:
    size = "num_envs=int(interval(8,64))"
    trials = study(
        tmp_path, size, "algo.num_minibatches=128", "sweep.sampler=random", "sweep.trials=3"
    )
    while trials.next():
        pass


def test_a_study_goes_on_with_what_was_running_and_what_failed(tmp_path: Path) -> None:
    first = study(tmp_path, *TOY)
    jobs = [job for _ in range(5) if (job := first.next()) is not None]
    first.tell(end(jobs[0], "completed", 1.0))
    first.tell(end(jobs[1], "failed", 0.5))
    first.tell(end(jobs[2], "interrupted"))
    first.tell(end(jobs[3], "pruned", 0.1))
    assert trial_states(tmp_path) == ["COMPLETE", "WAITING", "WAITING", "PRUNED", "RUNNING"]
    second = study(tmp_path, *TOY)
    # A killed sweep has left the last one.
    assert trial_states(tmp_path) == ["COMPLETE", "WAITING", "WAITING", "PRUNED", "WAITING"]
    earlier = [(job.number, job.progress.state) for job in second.earlier()]
    assert earlier == [(0, "waiting"), (3, "pruned")]
    again = [second.next() for _ in range(4)]
    assert [job.number for job in again if job] == [1, 2, 4, 5]
    assert [job.overrides for job in again[:3] if job] == [jobs[k].overrides for k in (1, 2, 4)]
    # The first command has begun with these numbers.
    assert again[3] is not None
    assert again[3].overrides not in [job.overrides for job in jobs]
    # A job that ended before goes on for more steps.
    (job, _) = second.earlier()
    assert not second.is_hopeless(job)
    second.tell(end(job, "completed", 2.0))


def trial_states(folder: Path) -> list[str]:
    """What a dashboard shows."""
    backend = JournalFileBackend(str(folder / "study.log"))
    storage = optuna.storages.JournalStorage(backend)
    return [
        one.state.name for one in optuna.load_study(study_name="sweep", storage=storage).trials
    ]


def test_trials_of_half_written_lines_do_not_keep_a_study_from_going_on(tmp_path: Path) -> None:
    first = study(tmp_path, *TOY, "algo.entropy_cost=interval(0,1e-2)")
    kept = first.next()
    assert kept is not None
    journal = tmp_path / "study.log"
    before = journal.stat().st_size
    assert first.next() is not None
    lines = journal.read_bytes()[before:].splitlines(keepends=True)
    # The disk got full within the second of its parameters.
    whole = journal.read_bytes()[:before] + b"".join(lines[:-2])
    journal.write_bytes(whole + lines[-1][: len(lines[-1]) // 2])
    again = study(tmp_path, *TOY, "algo.entropy_cost=interval(0,1e-2)")
    found = []
    while job := again.next():
        found.append(job.number)
        again.tell(end(job, "completed", 1.0))
    assert found == [0, *range(2, 9)]  # Still eight jobs.
    assert set(trial_states(tmp_path)) == {"COMPLETE", "FAIL"}


def test_the_study_gets_values_of_partial_windows_only_beside_others_of_such(
    tmp_path: Path,
) -> None:
    def states_after(*ends: tuple[float, bool], folder: Path) -> list[str]:
        folder.mkdir()
        trials = study(folder, *TOY, "sweep.pruner=median", "num_timesteps=100")
        for value, is_full in ends:
            job = trials.next()
            assert job is not None
            job.progress.is_full, job.progress.env_steps = is_full, 50
            job.progress.value = value
            assert not trials.is_hopeless(job)
            trials.tell(end(job, "completed", value))
        return trial_states(folder)

    early = [(-6.3, False), (-7.0, False)]
    assert states_after(*early, folder=tmp_path / "a") == ["COMPLETE", "COMPLETE"]
    mixed = [(-137.0, True), (-6.3, False), (-120.0, True)]
    assert states_after(*mixed, folder=tmp_path / "b") == ["COMPLETE", "FAIL", "COMPLETE"]


@pytest.mark.parametrize("pruner", ["asha", "median"])
def test_a_job_that_is_worse_than_others_were_is_hopeless(pruner: str, tmp_path: Path) -> None:
    trials = study(tmp_path, *TOY, f"sweep.pruner={pruner}", "num_timesteps=100")

    def course(value: float) -> bool:
        job = trials.next()
        assert job is not None
        for steps in range(1, 101):
            job.progress.env_steps, job.progress.value = steps, value
            if trials.is_hopeless(job):
                trials.tell(end(job, "pruned", value))
                return True
        trials.tell(end(job, "completed", value))
        return False

    assert not course(15.0)
    hopeless = [course(float(value)) for value in (12, 13, 14, 15, 16)]
    assert not all(hopeless)
    assert course(-5.0)
    kept = study(tmp_path, *TOY)
    assert len(kept.earlier()) == 7


def test_a_sampler_without_its_package_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match=r"pip install 'gmijax\[sweep\]'"):
        study(tmp_path, *TOY)
