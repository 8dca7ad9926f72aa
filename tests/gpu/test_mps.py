"""The mps backend on a real GPU, with a real daemon. Run with `pytest -m gpu tests/gpu`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from training_jobs import (
    FOREVER,
    STEPS,
    TINY,
    gmi_pid,
    iteration_of,
    kill,
    mps_directories,
    pids_of,
    start,
    train,
    wait_until,
)

from gmijax.machine.snapshot import detect_machine

pytestmark = [pytest.mark.gpu, pytest.mark.timeout(300)]

MPS = ("plan.gmis_per_gpu=2", "plan.backend=mps")


def _daemons() -> set[int]:
    """Processes of MPS daemons and servers."""
    found = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                command = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if b"nvidia-cuda-mps" in command:
                found.add(int(entry.name))
    return found


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    """No daemon, server or pipe directory may outlive a test."""
    daemons, directories = _daemons(), mps_directories()
    yield
    wait_until(lambda: _daemons() <= daemons, 15, "all daemons of the test gone")
    wait_until(lambda: mps_directories() <= directories, 15, "all their directories gone")


@pytest.mark.parametrize("backend", ["mps", "share"])
def test_two_gmis_train_on_one_gpu(backend: str, tmp_path: Path) -> None:
    done = train(
        *TINY, *MPS, f"plan.backend={backend}", f"num_timesteps={4 * 2 * STEPS}", "run.dir=run",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["plan"]["backend"] == backend
    assert summary["device"]["platform"] == "gpu"
    assert summary["env_steps"] == 4 * 2 * STEPS


def test_a_killed_gmi_is_named_and_the_daemon_goes_too(tmp_path: Path) -> None:
    run = tmp_path / "run"
    job = start(*TINY, *MPS, FOREVER, "run.dir=run", cwd=tmp_path)
    wait_until(lambda: iteration_of(run, 1) >= 2, 200, "two iterations")
    pid = gmi_pid(run, 1)
    assert pid is not None
    kill(pid)
    assert job.wait(timeout=60) == 1
    assert "GMI 1" in (tmp_path / "stderr.txt").read_text()
    assert pids_of(run) == []


def test_an_interrupt_saves(tmp_path: Path) -> None:
    run = tmp_path / "run"
    job = start(*TINY, *MPS, FOREVER, "run.dir=run", cwd=tmp_path)
    wait_until(lambda: iteration_of(run, 1) >= 2, 200, "two iterations")
    job.send_signal(signal.SIGINT)
    assert job.wait(timeout=60) == 130
    assert any((run / "checkpoints").iterdir())


def test_a_killed_controller_leaves_no_gmi_and_no_daemon(tmp_path: Path) -> None:
    run = tmp_path / "run"
    job = start(*TINY, *MPS, FOREVER, "run.dir=run", cwd=tmp_path)
    wait_until(lambda: iteration_of(run, 1) >= 1, 200, "an iteration")
    assert _daemons()
    job.kill()
    job.wait()
    wait_until(lambda: not [p for p in pids_of(run) if p in _gmis(run)], 10, "both GMIs gone")


def _gmis(run: Path) -> set[int | None]:
    return {gmi_pid(run, gmi) for gmi in range(2)}


def test_an_operators_daemon_is_used_and_left_alone(tmp_path: Path) -> None:
    control = detect_machine().mps_control
    assert control is not None
    pipes = tmp_path / "p"
    pipes.mkdir()
    environment = {
        **os.environ,
        "CUDA_MPS_PIPE_DIRECTORY": str(pipes),
        "CUDA_MPS_LOG_DIRECTORY": str(pipes),
    }
    subprocess.run([control, "-d"], env=environment, check=True, timeout=30)
    try:
        before = os.environ.get("CUDA_MPS_PIPE_DIRECTORY")
        os.environ["CUDA_MPS_PIPE_DIRECTORY"] = str(pipes)
        done = train(*TINY, *MPS, f"num_timesteps={2 * 2 * STEPS}", "run.dir=run", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert _daemons()
        if before is None:
            del os.environ["CUDA_MPS_PIPE_DIRECTORY"]
    finally:
        subprocess.run([control], input=b"quit\n", env=environment, check=True, timeout=30)


def test_capped_gmis_check_their_products_and_train(tmp_path: Path) -> None:
    done = train(
        *TINY, *MPS, "plan.sm_percent=[50,25]", f"num_timesteps={2 * 2 * STEPS}", "run.dir=run",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    plan = json.loads((tmp_path / "run" / "plan.json").read_text())
    assert plan["self_check"]
    assert [allocation["sm_percent"] for allocation in plan["allocations"]] == [50.0, 25.0]


def test_the_doctor_finds_gpu_and_mps_usable(tmp_path: Path) -> None:
    done = train("--json", cwd=tmp_path, command="doctor")
    found = json.loads(done.stdout)
    assert done.returncode == 0, found["problems"]
    usable = {one["name"] for one in found["abilities"] if one["usable"]}
    assert {"mps", "share", "mpr"} <= usable
    assert found["jax"]["platform"] == "gpu"


def test_memory_fractions_over_the_limit_are_refused(tmp_path: Path) -> None:
    done = train(*TINY, *MPS, "plan.memory_fraction=0.6", cwd=tmp_path)
    assert done.returncode == 2
    assert "plan.memory_fraction" in done.stderr


def test_a_gpu_that_is_not_there_is_refused(tmp_path: Path) -> None:
    done = train("plan.gpus=[99]", cwd=tmp_path)
    assert done.returncode == 2
    assert "99" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
