"""Real training jobs in real processes."""

from __future__ import annotations

import json
import random
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training_jobs import (
    FOREVER,
    POINT,
    STEPS,
    gmi_pid,
    iteration_of,
    kill,
    kill_somebody,
    learner_arrays,
    mps_directories,
    pids_of,
    shared_memory,
    start,
    train,
    wait_until,
)

from gmijax.runs.resume import find_checkpoint


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def two_gmis(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six iterations on two virtual GPUs, in one go."""
    cwd = tmp_path_factory.mktemp("two")
    done = train(
        *POINT, "plan.gpus=2", f"num_timesteps={6 * 2 * STEPS}", "run.dir=run",
        "run.measure_throughput=true", "run.checkpoint_every=3", cwd=cwd,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return cwd / "run"


@pytest.mark.timeout(300)
def test_two_gmis_leave_every_file_of_the_contract(two_gmis: Path) -> None:
    for name in ("config.json", "plan.json", "summary.json", "metrics.jsonl"):
        assert (two_gmis / name).is_file(), name
    assert any((two_gmis / "tensorboard").iterdir())
    assert sorted(p.name for p in (two_gmis / "checkpoints").iterdir()) == [
        f"{3 * 2 * STEPS:012d}",
        f"{6 * 2 * STEPS:012d}",
    ]
    for gmi in range(2):
        assert (two_gmis / f"gmi_{gmi}" / "stdout.log").is_file()
        assert (two_gmis / f"gmi_{gmi}" / "stderr.log").is_file()
        assert not (two_gmis / f"gmi_{gmi}" / "error.json").exists()


def test_the_summary_says_what_was_done(two_gmis: Path) -> None:
    summary = _read(two_gmis / "summary.json")
    assert (summary["status"], summary["env"]) == ("completed", "point.py:make")
    assert summary["env_steps"] == 6 * 2 * STEPS
    wanted = {
        "backend": "cpu",
        "layout": [[0], [1]],
        "num_envs_per_gmi": 16,
        "strategy": "mpr",
        "intra": "host",
        "template": "tcg_ex",
        "roles": ["simulator+agent+trainer"] * 2,
    }
    assert {key: summary["plan"][key] for key in wanted} == wanted
    assert Path(summary["checkpoint"]).is_dir()
    assert summary["versions"]["jax"]
    assert all(summary[f"step_per_s_{kind}"] > 0 for kind in ("sim", "inference", "train"))


def test_there_is_a_line_of_metrics_per_iteration(two_gmis: Path) -> None:
    lines = [json.loads(text) for text in (two_gmis / "metrics.jsonl").read_text().splitlines()]
    assert [line["env_steps"] for line in lines] == [k * 2 * STEPS for k in range(1, 7)]
    assert {"return", "env_steps_per_s", "loss/kl", "policy/learning_rate"} <= lines[-1].keys()


@pytest.mark.timeout(300)
def test_resuming_gives_bit_equal_parameters(two_gmis: Path) -> None:
    cwd = two_gmis.parent
    half = two_gmis / "checkpoints" / f"{3 * 2 * STEPS:012d}"
    # Only what changes is given again.
    again = (f"run.resume={half}", "run.dir=resumed", "run.measure_throughput=false")
    done = train(*again, cwd=cwd)
    assert done.returncode == 0, done.stderr
    whole, resumed = learner_arrays(two_gmis), learner_arrays(cwd / "resumed")
    assert len(whole) == len(resumed) > 10
    for a, b in zip(whole, resumed, strict=True):
        np.testing.assert_array_equal(a, b)
    lines = (cwd / "resumed" / "metrics.jsonl").read_text().splitlines()
    assert len(lines) == 6  # The history of the first half comes along.


@pytest.mark.timeout(300)
def test_two_gmis_compute_what_one_process_with_all_environments_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And reduce as was fastest when the job measured what its layout allows."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    # With a single minibatch the order of samples does not matter, so both see the same ones.
    same = ("algo.num_minibatches=1", "algo.num_updates_per_batch=3", f"num_timesteps={8 * STEPS}")
    for name, plan in (
        ("two", ("plan.gmis_per_gpu=2", "num_envs=16", "reduce.selection=measured")),
        ("one", ("plan.gmis_per_gpu=1", "num_envs=32")),
    ):
        done = train(*POINT, *same, *plan, f"run.dir={name}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert ("Algorithm 1 says mpr" in done.stdout) == (name == "two")
    for two, one in zip(
        learner_arrays(tmp_path / "two"), learner_arrays(tmp_path / "one"), strict=True
    ):
        # Twelve updates of Adam at 3e-4: a wrong gradient would move parameters by 4e-3.
        np.testing.assert_allclose(two, one, rtol=2e-3, atol=2e-4)
    plan = _read(tmp_path / "two" / "summary.json")["plan"]
    seconds = plan["selection"]["seconds"]
    assert set(seconds) == {"mpr", "har+host"}
    assert all(value > 0 for value in seconds.values())
    fastest = min(seconds, key=seconds.__getitem__)
    assert plan["selection"]["measured"] == fastest
    assert plan["strategy"] == fastest.partition("+")[0]
    (kept,) = (tmp_path / "cache" / "gmijax" / "reduction").iterdir()
    assert set(_read(kept)) == set(seconds)


@pytest.mark.timeout(300)
def test_an_interrupt_saves_and_stops_everything(tmp_path: Path) -> None:
    run = tmp_path / "run"
    job = start(*POINT, FOREVER, "plan.gpus=2", "run.dir=run", cwd=tmp_path)
    wait_until(lambda: iteration_of(run, 1) >= 2, 120, "two iterations")
    job.send_signal(signal.SIGINT)
    assert job.wait(timeout=90) == 130
    assert pids_of(run) == []
    assert _read(run / "summary.json")["status"] == "interrupted"
    checkpoint = find_checkpoint(str(run), "test")
    assert (checkpoint / "gmi_0").is_dir()
    assert (checkpoint / "gmi_1").is_dir()
    assert "run.resume=" in (tmp_path / "stderr.txt").read_text()


@pytest.mark.timeout(300)
def test_a_killed_gmi_ends_the_job_and_is_named(tmp_path: Path) -> None:
    run = tmp_path / "run"
    job = start(
        *POINT, FOREVER, "plan.gpus=2", "run.dir=run", "run.checkpoint_every=2", cwd=tmp_path
    )
    wait_until(lambda: iteration_of(run, 1) >= 4, 120, "four iterations")
    pid = gmi_pid(run, 1)
    assert pid is not None
    kill(pid)
    assert job.wait(timeout=90) == 1
    assert pids_of(run) == []
    errors = (tmp_path / "stderr.txt").read_text().strip().splitlines()
    assert "GMI 1" in errors[0]
    assert "SIGKILL" in errors[0]
    assert str(run) in errors[0]
    # What was saved before the fault is still whole, and there is no half of another one.
    assert find_checkpoint(str(run), "test").is_dir()
    assert _read(run / "summary.json")["status"] == "failed"


@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    "plan",
    [
        ("plan.gmis_per_gpu=2",),
        # Also while GMIs meet, when a library would rather end them by itself.
        ("plan.gpus=2", "reduce.strategy=mrr"),
    ],
    ids=["memory", "rings"],
)
def test_kills_at_any_moment_leave_nothing(plan: tuple[str, ...], tmp_path: Path) -> None:
    """Also while starting and compiling, GMIs and controller alike."""
    draw = random.Random(plan[0])
    shm, pipes = shared_memory(), mps_directories()
    for number in range(3):
        kill_somebody(*plan, cwd=tmp_path / str(number), draw=draw, within_s=(0.3, 7.0))
    assert shared_memory() <= shm
    assert mps_directories() <= pipes
