"""Two nodes of Ray on this machine with a GPU each. `pytest -m gpu tests/gpu/test_nodes_gpu.py`.

Their GPUs exchange by NCCL: over NVLink or PCIe, and over sockets as between machines.
"""

from __future__ import annotations

import importlib.util
import json
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training_jobs import (
    FOREVER,
    STEPS,
    TINY,
    events,
    gmi_pid,
    iteration_of,
    kill,
    learner_arrays,
    pids_of,
    start,
    train,
    wait_until,
)

from benchmarks.two_ray_nodes import RAY, Cluster, two_nodes
from gmijax.machine.snapshot import detect_machine
from gmijax.partition.reduction import why_no_bindings, why_no_nccl

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed"),
    pytest.mark.timeout(600),
]

ITERATIONS = 4
BALL = (*TINY, "physics.impl=jax", "cluster.wait_s=30")
SOCKETS = ("NCCL_P2P_DISABLE", "NCCL_SHM_DISABLE", "NCCL_IB_DISABLE")
WAYS = {"direct": (), "sockets": SOCKETS}


@pytest.fixture(scope="module")
def gpus() -> list[int]:
    if reason := why_no_nccl() or why_no_bindings():
        pytest.skip(reason)
    found = [gpu.index for gpu in detect_machine().gpus]
    if len(found) < 2:
        pytest.skip("needs 2 GPUs")
    return found[:2]


@pytest.fixture(scope="module")
def cluster(gpus: list[int], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with two_nodes(tmp_path_factory.mktemp("ray") / "stderr.txt", gpus) as nodes:
        yield nodes


def set_nccl(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Nodes get them from the controller.
    monkeypatch.setenv("NCCL_DEBUG", "INFO")
    for name in WAYS[way]:
        monkeypatch.setenv(name, "1")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("gmis", "here", "there"), [(1, "flat", "flat"), (2, "har", "one_shot")])
def test_two_nodes_learn_what_one_with_two_gpus_learns(
    gmis: int,
    here: str,
    there: str,
    way: str,
    gpus: list[int],
    cluster: Cluster,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Otherwise a job differs from itself: sums with atomic operations, products in TF32.
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_deterministic_ops=true")
    monkeypatch.setenv("JAX_DEFAULT_MATMUL_PRECISION", "highest")
    backend = "mps" if gmis > 1 else "share"
    common = (
        *(*BALL, f"num_timesteps={ITERATIONS * 2 * gmis * STEPS}"),
        *(f"plan.gmis_per_gpu={gmis}", f"plan.backend={backend}"),
    )
    # Both sum first on a GPU, then over two: the bits could only differ by that order.
    one = (f"plan.gpus=[{gpus[0]},{gpus[1]}]", f"reduce.strategy={here}", "run.dir=one")
    done = train(*common, *one, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    set_nccl(way, monkeypatch)
    two = (RAY, cluster.address, "cluster.nodes=2", "run.dir=two")
    done = train(*common, *two, cwd=tmp_path)
    assert done.returncode == 0, done.stderr

    expected = learner_arrays(tmp_path / "one")
    assert len(expected) > 10
    for array, other in zip(learner_arrays(tmp_path / "two"), expected, strict=True):
        np.testing.assert_allclose(array, other, rtol=1e-4, atol=3e-6)
    plan = json.loads((tmp_path / "two" / "plan.json").read_text())
    used = json.loads((tmp_path / "two" / "summary.json").read_text())["plan"]
    for found in (plan, used):
        assert (found["strategy"], found["inter"]) == (there, "nccl")
        assert [node["gmis"] for node in found["nodes"]] == [
            list(range(gmis)),
            list(range(gmis, 2 * gmis)),
        ]
    log = (tmp_path / "two" / "gmi_0" / "stdout.log").read_text()
    channels = re.findall(r"via (\w+)/", log)
    assert channels, log
    assert set(channels) == {"NET"} if way == "sockets" else "NET" not in channels


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("gmis", "victim"), [(1, 1), (2, 3)])
def test_a_killed_gmi_of_the_other_node_is_named_and_the_job_goes_on(
    gmis: int,
    victim: int,
    way: str,
    cluster: Cluster,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    set_nccl(way, monkeypatch)
    run = tmp_path / "run"
    job = start(
        *(*BALL, FOREVER, RAY, cluster.address, "cluster.nodes=2", "run.dir=run"),
        *(f"plan.gmis_per_gpu={gmis}", "run.max_restarts=1", "run.checkpoint_every=5"),
        cwd=tmp_path,
    )

    def wait(condition: Any, what: str) -> None:
        log = tmp_path / "stderr.txt"
        wait_until(lambda: condition() or job.poll() is not None, 240, what)
        assert job.poll() is None, log.read_text()

    try:
        wait(lambda: iteration_of(run, victim) > 6, "the job trains")
        kill(gmi_pid(run, victim) or 0)
        wait(lambda: len(events(run, "recovered")) == 1, "it goes on")
        [fault] = events(run, "fault")
        assert fault["gmi"] == victim
        assert "SIGKILL" in fault["cause"]
        wait(lambda: iteration_of(run, 0) > 6, "both nodes train again")
        job.send_signal(signal.SIGTERM)
        assert job.wait(120) == 130
    finally:
        kill(job.pid)
        job.wait()
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["plan"]["inter"], len(summary["restarts"])) == ("nccl", 1)
    assert not pids_of(run)
