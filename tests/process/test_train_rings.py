"""Training over rings between virtual GPUs: equal parameters, and an end whatever dies."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from training_jobs import (
    FOREVER,
    POINT,
    STEPS,
    TINY,
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
    """The learner after `ITERATIONS` on two GPUs.

    Without contacts: where one begins a step earlier because a sum was rounded otherwise, so may
    all that follows.
    """
    plan = (layout, f"plan.gmis_per_gpu={gmis_per_gpu}", f"reduce.strategy={strategy}")
    steps = ITERATIONS * 2 * gmis_per_gpu * STEPS
    run = (f"num_timesteps={steps}", f"run.dir={strategy}")
    done = train(*POINT, *plan, *run, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return learner_arrays(cwd / strategy)


def _assert_same(found: list[np.ndarray], expected: list[np.ndarray], what: str) -> None:
    assert len(found) > 10
    for array, other in zip(found, expected, strict=True):
        # Each of 52 updates moves a parameter by 3e-4 at most.
        np.testing.assert_allclose(array, other, rtol=1e-4, atol=3e-6, err_msg=what)


@pytest.mark.timeout(400)
def test_two_gmis_learn_the_same_bits_through_host_memory_and_rings(tmp_path: Path) -> None:
    # The sum of two numbers has one order only.
    mpr, har = (_trained(strategy, 1, tmp_path) for strategy in ("mpr", "har"))
    assert len(mpr) > 10
    for other, expected in zip(har, mpr, strict=True):
        np.testing.assert_array_equal(other, expected)


@pytest.mark.timeout(400)
def test_one_program_of_two_gmis_learns_what_several_programs_do(tmp_path: Path) -> None:
    mpr, mrr = (_trained(name, 1, tmp_path) for name in ("mpr", "mrr"))
    # With the GMIs the other way round: GMI 0 is not the first of the ring.
    flat = _trained("flat", 1, tmp_path, "plan.layout=[[1],[0]]")
    _assert_same(mrr, mpr, "mrr")
    for other, expected in zip(flat, mrr, strict=True):
        np.testing.assert_array_equal(other, expected)


def _last_line(run: Path) -> dict[str, float]:
    return json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])


@pytest.mark.timeout(400)
def test_one_program_of_two_gmis_goes_on_from_a_checkpoint(tmp_path: Path) -> None:
    # A task of MuJoCo, whose model has arrays without elements.
    plan = ("plan.gpus=2", "reduce.strategy=mrr", "run.checkpoint_every=2")
    whole = train(*TINY, *plan, f"num_timesteps={8 * STEPS}", "run.dir=whole", cwd=tmp_path)
    assert whole.returncode == 0, whole.stderr
    half = tmp_path / "whole" / "checkpoints" / f"{4 * STEPS:012d}"
    options = (f"num_timesteps={8 * STEPS}", f"run.resume={half}", "run.dir=resumed")
    resumed = train(*TINY, *plan, *options, cwd=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    found, wanted = (learner_arrays(tmp_path / name) for name in ("resumed", "whole"))
    for array, expected in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(array, expected)


@pytest.mark.timeout(120)
def test_a_gmi_that_hangs_in_the_program_of_all_is_named(tmp_path: Path) -> None:
    plan = ("plan.gpus=2", "reduce.strategy=flat", "reduce.timeout_s=2", "run.dir=run")
    job = start(*POINT, FOREVER, *plan, cwd=tmp_path)
    run = tmp_path / "run"
    wait_until(lambda: iteration_of(run, 1) > 5, 60, "GMI 1 has trained")
    pid = gmi_pid(run, 1)
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    assert job.wait(timeout=40) == 1
    said = (tmp_path / "stderr.txt").read_text()
    assert "ranks [1]" in said, said
    wait_until(lambda: not pids_of(run), 10, "all GMIs gone")


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_four_gmis_learn_the_same_under_every_strategy(tmp_path: Path) -> None:
    mpr = _trained("mpr", 2, tmp_path)
    for strategy in ("mrr", "har"):
        _assert_same(_trained(strategy, 2, tmp_path), mpr, strategy)
