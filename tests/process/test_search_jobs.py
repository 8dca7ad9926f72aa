"""`python -m gmijax.search` as a user runs it, with profiles that are real jobs on the CPU."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest
from training_jobs import POINT_TASK, pids_of, train

pytestmark = pytest.mark.timeout(600)

# It compiles in seconds. With 24 environments it brings its process down, with 32 it hangs.
TASK = POINT_TASK.replace(
    "    return point",
    "    import os, time\n    if max_envs == 24:\n        os.abort()\n"
    "    if max_envs == 32:\n        time.sleep(600)\n    return point",
)
JOB = (
    *("env=point.py:make", "search.store=store", "algo.unroll_length=4"),
    *("algo.num_updates_per_batch=1", "run.grace_s=3"),
    *("algo.policy_hidden_layer_sizes=[8]", "algo.value_hidden_layer_sizes=[8]"),
)
GRID = (*("search.gmis_per_gpu=[2,1]", "search.num_envs=[16,24]"),)


def search(*overrides: str, cwd: Path) -> dict[str, Any]:
    """Report of a search, of whose profiles nothing but logs is left."""
    (cwd / "point.py").write_text(TASK)
    done = train(*overrides, "run.dir=s", cwd=cwd, command="search")
    assert done.returncode == 0, done.stderr
    report = json.loads((cwd / "s" / "search.json").read_text())
    assert report["complete"]
    assert report["reason"] in done.stdout
    words = shlex.split(done.stdout.rpartition("\n  ")[2])
    best, given, num_envs = report["best"], list(overrides), "auto"
    if "serving_gpus" not in best:
        given, num_envs = [w for w in given if not w.startswith("search.")], best["num_envs"]
    expected = ["gmijax", "train", *given, f"num_envs={num_envs}"]
    assert words[: len(expected)] == expected
    for run in (cwd / "s" / "profiles").iterdir():
        assert pids_of(run) == []
        assert not (run / "checkpoints").exists()
    return report


def trained_with_auto(report: dict[str, Any], *overrides: str, cwd: Path) -> Path:
    """The run of a job for which nothing was profiled, because the store has all of it."""
    auto = ("num_envs=auto", "plan.gmis_per_gpu=auto")
    done = train(*overrides, *auto, "run.dir=t", cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert report["reason"] in done.stdout
    assert not (cwd / "runs").exists()
    return cwd / "t"


def test_a_search_answers_survives_a_crash_and_serves_a_training(tmp_path: Path):
    report = search(*JOB, *GRID, cwd=tmp_path)
    points = {(one["gmis_per_gpu"], one["num_envs"]): one for one in report["points"]}
    assert set(points) == {(2, 16), (2, 24), (1, 16), (1, 24)}
    for gmis in (1, 2):
        assert "SIGABRT" in points[gmis, 24]["reason"]
        one = points[gmis, 16]
        assert one["projected"] == pytest.approx(gmis * one["env_steps_per_s"])
        assert one["env_steps_per_s"] * one["iteration_s"] == pytest.approx(16 * 4)
        assert 100 < one["memory_mib"] < 10_000  # The whole process's, on a CPU.
        assert (one["reduce_s"] > 0) == (gmis == 2)
    assert report["best"]["num_envs"] == 16
    run = trained_with_auto(report, *JOB, *GRID, "num_timesteps=64", cwd=tmp_path)
    config = json.loads((run / "config.json").read_text())
    found = (config["num_envs"], config["plan"]["gmis_per_gpu"])
    assert found == (16, report["best"]["gmis_per_gpu"])


def test_what_takes_too_long_is_ended_and_not_runnable(tmp_path: Path):
    (tmp_path / "point.py").write_text(TASK)
    limits = ("search.gmis_per_gpu=[2]", "search.num_envs=[32]", "search.budget_s=10")
    done = train(*JOB, *limits, "run.dir=s", cwd=tmp_path, command="search")
    assert done.returncode == 1, done.stderr
    assert "no point of the search can run" in done.stderr
    assert "did not end within 5 s (GMI 0 " in done.stderr
    assert pids_of(tmp_path / "s" / "profiles" / "2x32-jax") == []


def test_an_asynchronous_job_gets_gmis_and_gpus_that_act_and_train(tmp_path: Path):
    job = (
        *JOB, "algo=a3c", "algo.num_minibatches=2", "plan.gpus=2", "reduce.timeout_s=60",
        "search.gmis_per_gpu=[2]", "search.num_envs=[16]",
    )  # fmt: skip
    report = search(*job, cwd=tmp_path)
    points = {(one["gmis_per_gpu"], one["trainers"]): one for one in report["points"]}
    assert set(points) == {(2, 1)}
    for (gmis, _), one in points.items():
        metrics = tmp_path / "s" / "profiles" / f"{gmis}+1x16-jax" / "metrics.jsonl"
        lines = [json.loads(text) for text in metrics.read_text().splitlines()]
        rates = [line[f"async/{what}"] for line in lines[1:-1] for what in ("pps", "ttop")]
        assert min(rates) <= gmis * one["env_steps_per_s"] <= max(rates)
        assert 100 < one["memory_mib"] < 10_000
    best = report["best"]
    # How more GPUs are divided: tests/unit/test_async_search.py.
    assert (best["serving_gpus"], best["training_gpus"]) == (1, 1)
    assert f"{best['serving_gpus']} GPU" in report["reason"]
    run = trained_with_auto(report, *job, "num_timesteps=640", cwd=tmp_path)
    plan = json.loads((run / "plan.json").read_text())
    assert plan["roles"].count("trainer") == best["training_gpus"]
    assert len(plan["roles"]) == sum(
        gpus * gmis
        for gpus, gmis in (
            (best["serving_gpus"], best["gmis_per_gpu"]),
            (best["training_gpus"], best["trainers"]),
        )
    )
