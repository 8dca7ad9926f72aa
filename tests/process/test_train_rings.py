"""Training over rings between virtual GPUs: equal parameters, and an end whatever dies."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from training_jobs import (
    FOREVER,
    POINT,
    STEPS,
    gmi_pid,
    iteration_of,
    learner_arrays,
    pids_of,
    start,
    train,
    wait_until,
)

ITERATIONS = 13
"""Of four updates each: 52 updates."""


def _trained(
    strategy: str, gmis_per_gpu: int, cwd: Path, layout: str = "plan.gpus=2"
) -> list[np.ndarray]:
    """The learner after `ITERATIONS` on two GPUs, with a checkpoint after six of them.

    Without contacts: where one begins a step earlier because a sum was rounded otherwise, so may
    all that follows.
    """
    plan = (layout, f"plan.gmis_per_gpu={gmis_per_gpu}", f"reduce.strategy={strategy}")
    steps = 2 * gmis_per_gpu * STEPS
    run = (f"num_timesteps={ITERATIONS * steps}", "run.checkpoint_every=6", f"run.dir={strategy}")
    done = train(*POINT, *plan, *run, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return learner_arrays(cwd / strategy)


def _assert_same(found: list[np.ndarray], expected: list[np.ndarray], what: str) -> None:
    assert len(found) > 10
    for array, other in zip(found, expected, strict=True):
        # Each of 52 updates moves a parameter by 3e-4 at most.
        np.testing.assert_allclose(array, other, rtol=1e-4, atol=3e-6, err_msg=what)


def _assert_equal(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    assert len(found) > 10
    for array, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(array, other)


@pytest.mark.timeout(400)
def test_two_gmis_learn_the_same_whatever_the_strategy_and_go_on(tmp_path: Path) -> None:
    mpr, mrr = (_trained(strategy, 1, tmp_path) for strategy in ("mpr", "mrr"))
    # One program of both GMIs, where the others are one of each.
    _assert_same(mrr, mpr, "mrr")
    # With the GMIs the other way round: GMI 0 is not the first of the ring.
    _assert_equal(_trained("flat", 1, tmp_path, "plan.layout=[[1],[0]]"), mrr)

    half = tmp_path / "mrr" / "checkpoints" / f"{6 * 2 * STEPS:012d}"
    # Only what changes is given again.
    done = train(f"run.resume={half}", "run.dir=resumed", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    _assert_equal(learner_arrays(tmp_path / "resumed"), mrr)
    lines = (tmp_path / "resumed" / "metrics.jsonl").read_text().splitlines()
    assert len(lines) == ITERATIONS  # The history of the first part comes along.


@pytest.mark.timeout(120)
def test_a_gmi_that_hangs_in_the_program_of_all_is_named(tmp_path: Path) -> None:
    plan = ("plan.gpus=2", "reduce.strategy=flat", "reduce.timeout_s=2", "run.dir=run")
    job = start(*POINT, FOREVER, *plan, cwd=tmp_path)
    run = tmp_path / "run"
    wait_until(lambda: iteration_of(run, 1) > 5, 90, "GMI 1 has trained")
    pid = gmi_pid(run, 1)
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    assert job.wait(timeout=90) == 1
    stderr = (tmp_path / "stderr.txt").read_text()
    assert "for GMIs [1]" in stderr, stderr
    wait_until(lambda: not pids_of(run), 60, "all GMIs gone")


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_four_gmis_learn_the_same_under_every_strategy(tmp_path: Path) -> None:
    mpr = _trained("mpr", 2, tmp_path)
    for strategy in ("mrr", "har"):
        _assert_same(_trained(strategy, 2, tmp_path), mpr, strategy)
