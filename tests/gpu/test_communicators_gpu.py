"""Every reduction strategy on real GPUs. Run `pytest -m gpu tests/gpu/test_communicators_gpu.py`.

With pytest-xdist (`-n 4`) the cases of the contract run at the same time, from another GPU on in
each worker. Learning (`-k learning`) wants the GPUs for itself: a job takes most of their memory.
"""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from training_jobs import POINT_TASK, STEPS, TINY, learner_arrays, train

from gmijax.machine.snapshot import detect_machine
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import why_no_nccl, why_not_intra
from tests.communicator_contract import (
    PAIRS,
    RINGS_OVER_NODES,
    Case,
    RingsOverNodes,
    check_contract,
    check_rings_over_nodes,
)

pytestmark = [pytest.mark.gpu, pytest.mark.timeout(200)]

STRATEGIES = ("mrr", "har", "flat", "one_shot")
FOUR = Case(Layout.even(4, 1), 100_003, signal.SIGKILL, 2)
FOUR_BY_FOUR = Case(Layout.even(4, 4), 290_000, signal.SIGSTOP, 5)
ALL = [
    # Through host memory alone there is no GPU in it.
    *((strategy, intra, case) for strategy, intra, case in PAIRS if strategy in STRATEGIES),
    *((strategy, "host", FOUR) for strategy in ("mrr", "flat")),
    *(("mrr", "host", FOUR_BY_FOUR), ("har", "ipc", FOUR_BY_FOUR)),
    ("one_shot", "ipc", FOUR_BY_FOUR),
]
ITERATIONS = 13
"""Of four updates each: 52 updates."""

WAYS = {
    1: ("mrr", "flat", "har", "one_shot"),
    2: ("mrr", "har", "one_shot"),
}
"""What is compared with mpr, by GMIs on each of two GPUs."""


def _gpus(count: int) -> list[int]:
    """Indices of `count` GPUs."""
    found = [gpu.index for gpu in detect_machine().gpus]
    if len(found) < count:
        pytest.skip(f"needs {count} GPUs")
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    return [found[(worker * count + k) % len(found)] for k in range(count)]


def _require(intra: str) -> None:
    if reason := why_not_intra(intra, "share"):
        pytest.skip(reason)


@pytest.mark.parametrize(
    ("strategy", "intra", "case"),
    ALL,
    ids=[f"{name}-{intra}-{case.layout}" for name, intra, case in ALL],
)
def test_the_contract(strategy: str, intra: str, case: Case, tmp_path: Path) -> None:
    _require(intra)
    check_contract(strategy, intra, case, tmp_path, _gpus(case.layout.num_gpus))


@pytest.mark.parametrize("sockets", [False, True])
@pytest.mark.parametrize("case", RINGS_OVER_NODES, ids=str)
def test_nodes_exchange_in_rings_and_see_the_end_of_another(
    case: RingsOverNodes, sockets: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The GPUs of two nodes, which are this machine: over NVLink or PCIe, and over sockets."""
    _require("ipc")
    if reason := why_no_nccl():
        pytest.skip(reason)
    if sockets:
        for name in ("NCCL_P2P_DISABLE", "NCCL_SHM_DISABLE", "NCCL_IB_DISABLE"):
            monkeypatch.setenv(name, "1")
    check_rings_over_nodes(case, tmp_path, _gpus(2))


@pytest.mark.timeout(400)
@pytest.mark.parametrize("gmis_per_gpu", WAYS)
def test_learning_does_not_depend_on_the_strategy(
    gmis_per_gpu: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parameters after 52 updates agree to the order of sums, on two GPUs.

    The task has no contacts: where one begins a step earlier because a sum was rounded otherwise,
    all that follows is different.
    """
    _require("ipc")
    (tmp_path / "point.py").write_text(POINT_TASK)
    # Otherwise a job differs from itself: sums with atomic operations, products in TF32.
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_deterministic_ops=true")
    monkeypatch.setenv("JAX_DEFAULT_MATMUL_PRECISION", "highest")
    gpus = ",".join(map(str, _gpus(2)))
    backend = "mps" if gmis_per_gpu > 1 else "share"
    plan = (f"plan.gpus=[{gpus}]", f"plan.gmis_per_gpu={gmis_per_gpu}", f"plan.backend={backend}")
    steps = ITERATIONS * 2 * gmis_per_gpu * STEPS

    def trained(way: str) -> list[np.ndarray]:
        # Letters only: the folder is a value on a command line.
        run = tmp_path / re.sub(r"[^a-z]+", "-", way)
        overrides = f"reduce.strategy={way} num_timesteps={steps} run.dir={run}".split()
        done = train("env=point.py:make", *TINY[1:], *plan, *overrides, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return learner_arrays(run)

    expected = trained("mpr")
    assert len(expected) > 10
    for way in WAYS[gmis_per_gpu]:
        for found, array in zip(trained(way), expected, strict=True):
            # Each update moves a parameter by 3e-4 at most.
            np.testing.assert_allclose(found, array, rtol=1e-4, atol=3e-6, err_msg=way)


@pytest.mark.timeout(300)
def test_iterations_of_one_of_two_gmis_are_traced_for_a_profile(tmp_path: Path) -> None:
    """Both wait for the traced iterations, which is a step of their devices."""
    _require("ipc")
    (tmp_path / "point.py").write_text(POINT_TASK)
    [gpu] = _gpus(1)
    plan = (f"plan.gpus=[{gpu}]", "plan.gmis_per_gpu=2", "reduce.strategy=one_shot")
    steps = ("num_timesteps=768", "run.profile=2:3", "run.dir=run")
    done = train("env=point.py:make", *TINY[1:], *plan, *steps, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["plan"]["strategy"], summary["plan"]["intra"]) == ("one_shot", "ipc")
    assert summary["profile"]["iterations"] == [2, 3]
    assert list((tmp_path / "run").glob("profile/plugins/profile/*/perfetto_trace.json.gz"))


@pytest.mark.timeout(300)
@pytest.mark.parametrize("impl", ["jax", "warp"])
def test_a_task_of_mujoco_trains_as_one_program(impl: str, tmp_path: Path) -> None:
    # Its model has arrays with no elements, and its functions constants of their own: XLA's
    # compiler for GPUs crashes over either where they are arguments of such a program.
    if impl == "warp":
        pytest.importorskip("warp", reason="warp-lang is not installed")
    gpus = ",".join(map(str, _gpus(2)))
    size = ("num_envs=64", "algo.unroll_length=4", "num_timesteps=1536")
    plan = (f"plan.gpus=[{gpus}]", "reduce.strategy=flat", f"physics.impl={impl}")
    done = train("env=ant", *size, *plan, "run.dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert len(lines) == 3
    assert "time/update_s" not in lines[-1]
