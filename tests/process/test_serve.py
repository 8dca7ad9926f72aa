"""`python -m gmijax.serve` as a user runs it, on a task without physics."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_lines import run as run_here
from test_custom_task import SMALL, TASK
from training_jobs import gmi_pid, kill, pids_of, start, train, wait_until

from gmijax.runs.dataset import DataPaths

pytestmark = pytest.mark.timeout(600)

TINY = (
    *("num_envs=16", "unroll_length=4", "latency_steps=20"),
    "run.grace_s=3",
)
STEPS = 16 * 4
"""Environment steps of one shard of a TINY job."""

RANDOM = ("env=point.py:make", "policy=random", *TINY)


def serve(*overrides: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return train(*overrides, cwd=cwd, command="serve")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory with a task of its own and a run that has hardly been trained."""
    folder = tmp_path_factory.mktemp("home")
    (folder / "point.py").write_text(TASK)
    done = train("env=point.py:make", *SMALL, "num_timesteps=64", "run.name=tiny", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder


def arrays(folder: Path) -> dict[str, dict[str, Any]]:
    """All arrays of all finished shards, by shard."""
    found = {}
    for shard in DataPaths(folder).finished():
        with np.load(shard.arrays) as file:
            found[f"{shard.arrays.parent.name}/{shard.arrays.name}"] = dict(file)
    return found


def summary_of(home: Path, name: str) -> dict[str, Any]:
    return json.loads((home / "runs" / name / "summary.json").read_text())


def finished(folder: Path) -> int:
    return len(list(DataPaths(folder).finished()))


def test_what_is_auto_is_found_first(home: Path):
    wanted = ("num_envs=auto", "plan.gmis_per_gpu=auto", "num_timesteps=128", "run.name=auto")
    grid = ("search.gmis_per_gpu=[1]", "search.num_envs=[16]", "search.store=profiles")
    task = ("env=point.py:make", "policy=random", *TINY[1:])
    done = serve(*task, *wanted, *grid, cwd=home)
    assert done.returncode == 0, done.stderr
    plan = summary_of(home, "auto")["plan"]
    assert plan["layout"] == [[0]]
    assert plan["num_envs_per_gmi"] == 16
    assert "env steps/s" in done.stdout
    assert len(list((home / "profiles").glob("*.json"))) == 1


def test_both_templates_collect_the_same_experience(home: Path):
    """With the policy of a run, whose task need not be named."""
    shared = ("run.dir=runs/tiny", *TINY, "num_timesteps=500", "output.next_obs=true")
    collocated = ("plan.gmis_per_gpu=2", "run.name=tcg", "output.dir=a")
    dedicated = ("plan.gmis_per_gpu=3", "plan.template=tdg", "run.name=tdg", "output.dir=b")
    for template in (collocated, dedicated):
        done = serve(*shared, *template, cwd=home)
        assert done.returncode == 0, done.stderr
        assert "env steps/s with all GMIs" in done.stdout
    tcg, tdg = arrays(home / "a"), arrays(home / "b")
    assert len(tcg) == 8  # 8 shards of 64 steps are the fewest that hold 500, and 4 a GMI.
    assert tcg.keys() == tdg.keys()
    for name, shard in tcg.items():
        assert shard["obs"].shape == shard["next_obs"].shape == (4, 16, 1)
        for key, array in shard.items():
            assert np.isfinite(array).all()
            np.testing.assert_allclose(array, tdg[name][key], atol=1e-5, err_msg=f"{name} {key}")
    first, second = tcg["gmi_000/000000.npz"], tcg["gmi_001/000000.npz"]
    assert not np.array_equal(first["obs"], second["obs"])
    check_summary(summary_of(home, "tcg"), ["simulator+agent"] * 2)
    check_summary(summary_of(home, "tdg"), ["agent", "simulator", "simulator"])
    assert set(summary_of(home, "tdg")["stages_ms"]) == {"infer", "simulate", "exchange"}
    about = json.loads((home / "a" / "gmi_001" / "000000.json").read_text())
    assert about["first_env"] == 16
    assert about["policy"] == summary_of(home, "tdg")["policy"]["digest"]
    assert len(about["policy"]) == 64


def check_summary(summary: dict[str, Any], roles: list[str]) -> None:
    assert summary["status"] == "completed"
    assert summary["plan"]["roles"] == roles
    assert summary["env_steps"] == 8 * STEPS
    assert summary["env_steps_per_s"] > 0
    assert 0 < summary["latency_ms"]["p50"] <= summary["latency_ms"]["p99"]
    assert summary["episodes"] == 96  # Each of 32 environments ends three in 16 steps.
    assert summary["mean_length"] == 5
    assert summary["mean_return"] < 0
    assert summary["output"]["env_steps"] == 8 * STEPS
    assert summary["policy"]["trained_env_steps"] == 64


def test_after_a_kill_the_same_command_goes_on(home: Path, request: pytest.FixtureRequest):
    folder, run = home / "kill", home / "runs" / "kill"
    job = (*RANDOM, "plan.gmis_per_gpu=3", "plan.template=tdg", "output.dir=kill")
    process = start(*job, "num_timesteps=1e9", "run.name=kill", cwd=home, command="serve")
    request.addfinalizer(process.kill)
    wait_until(lambda: finished(folder) >= 3, 240, "three shards")
    kill(gmi_pid(run, 0) or 0)
    assert process.wait(timeout=120) == 1
    errors = (home / "stderr.txt").read_text()
    assert "GMI 0 failed: ended by SIGKILL" in errors
    assert not pids_of(run)
    assert summary_of(home, "kill")["status"] == "failed"
    kept = {shard.arrays: shard.arrays.stat() for shard in DataPaths(folder).finished()}
    simulators = json.loads((folder / "dataset.json").read_text())["num_simulators"]
    each = max(DataPaths(folder).num_finished(rank) for rank in range(simulators)) + 2
    wanted = each * simulators * STEPS
    done = serve(*job, f"num_timesteps={wanted}", "run.name=kill-2", cwd=home)
    assert done.returncode == 0, done.stderr
    assert f"{len(kept)} of {each * simulators} shards are there" in done.stdout
    assert finished(folder) == each * simulators
    assert not list(folder.rglob(".*"))
    assert all(path.stat() == at for path, at in kept.items())
    starts = [json.loads(shard.about.read_text()) for shard in DataPaths(folder).finished()]
    from_reset = {
        (item["first_env"], item["shard"]) for item in starts if item["starts_with_reset"]
    }
    resumed = {
        (rank * 16, sum(path.parent.name == f"gmi_{rank:03d}" for path in kept))
        for rank in range(simulators)
    }
    assert from_reset == resumed | {(rank * 16, 0) for rank in range(simulators)}
    shards = arrays(folder)
    starts = {shard["obs"].tobytes() for shard in shards.values()}
    assert len(starts) == len(shards)  # Nothing was collected twice.
    again = run_here("serve", *job, f"num_timesteps={wanted}", cwd=home)
    assert again.code == 2
    assert f"has {wanted} steps already" in again.stderr


def test_an_interrupted_job_leaves_whole_shards(home: Path, request: pytest.FixtureRequest):
    job = (*RANDOM, "plan.gmis_per_gpu=2", "plan.template=tdg", "num_timesteps=1e9")
    job = (*job, "run.stop_timeout_s=1e-6")  # That is the time after other signals.
    process = start(*job, "run.name=int", "output.dir=int", cwd=home, command="serve")
    request.addfinalizer(process.kill)
    wait_until(lambda: finished(home / "int") >= 2, 240, "two shards")
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=120) == 130
    assert "the same command makes the rest" in (home / "stderr.txt").read_text()
    folder = home / "int"
    assert len(list(folder.rglob("*.npz"))) == finished(folder) >= 2
    assert not list(folder.rglob(".*"))
    summary = summary_of(home, "int")
    assert summary["status"] == "interrupted"
    assert summary["output"]["shards"] == finished(folder)
    assert summary["env_steps"] == finished(folder) * STEPS


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["run.dir=runs/tiny", "env=ant"], "env=ant: run.dir=runs/tiny was trained on point.py"),
        ([*RANDOM, "plan.template=tdg"], "plan.template=tdg: GPU 0 of layout [[0]] has one GMI"),
        ([*RANDOM, "output.dir=runs"], "the folder is not empty and holds no experience"),
        ([*RANDOM, "run.name=tiny"], "the run folder exists already"),
        ([*RANDOM, "run.dir=runs/tiny"], "acts without the policy of run.dir"),
    ],
)
def test_bad_input_starts_nothing(overrides: list[str], message: str, home: Path):
    before = sorted(home.glob("*"))
    done = run_here("serve", *overrides, cwd=home)
    assert done.code == 2, done.stderr
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert sorted(home.glob("*")) == before
