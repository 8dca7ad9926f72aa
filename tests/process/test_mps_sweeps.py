"""Sweeps with the daemons of a fake control program: one for each GPU, for all of its jobs."""

from __future__ import annotations

import json
import os
from contextlib import closing
from pathlib import Path

import pytest
from fake_mps import FakeMps
from supervision import CHECKOUT, TESTS, gpu, machine, planned

from gmijax.cli.compose import compose
from gmijax.config.sweep import SweepConfig
from gmijax.machine.mps_control import PIPE_VARIABLE, MpsControl
from gmijax.machine.snapshot import DAEMONS_VARIABLE, detect_machine
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends import open_backend
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps.children import Process
from gmijax.sweeps.host import LocalHost, client_variables, variables_of
from gmijax.sweeps.jobs import Job, jobs_of
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.scheduler import Scheduler
from gmijax.sweeps.slots import Site, SlotPool, plan_slots
from gmijax.sweeps.study import Study
from gmijax.sweeps.training import TrainingKind

pytestmark = pytest.mark.timeout(180)


@pytest.fixture
def mps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeMps:
    return FakeMps(tmp_path, monkeypatch)


def test_a_fatal_fault_ends_one_job_of_a_sweep_and_its_neighbours_go_on(
    mps: FakeMps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("gmijax.sweeps.training.MODULE", "fake_training_job")
    monkeypatch.setenv("PYTHONPATH", f"{CHECKOUT}{os.pathsep}{TESTS}")
    here = machine(2, mps_control=mps.program)
    jobs = list(jobs_of([compose(f"seed={n}") for n in range(6)]))
    settings, paths = SweepConfig(jobs_per_gpu=3, objective="return"), SweepPaths(tmp_path)
    plan = plan_slots(settings, here, {"auto"})
    with closing(LocalHost(here)) as host:
        host.open(plan, paths)
        slots = SlotPool([Site(plan, here)])
        kind = TrainingKind(settings, paths)
        scheduler = Scheduler(
            jobs, Study[Job](), kind, settings, paths, slots, [host], lambda: None
        )
        scheduler.run(StopSignals())
    states = [job.progress.state for job in jobs]
    assert states == ["completed", "failed", *["completed"] * 4]
    assert "CUDA_ERROR_LAUNCH_FAILED" in str(jobs[1].progress.error)
    starts = [(paths.job(n).root / "starts").read_text().splitlines() for n in range(6)]
    assert [len(lines) for lines in starts] == [1, 2, 1, 2, 1, 2]
    # From their checkpoints, and nobody beside them: it could be the fault of each.
    assert {starts[n][1] for n in (1, 3, 5)} == {"from step 5 beside 0"}
    assert [job.progress.value for job in jobs] == [10.0, 5.0, 10.0, 10.0, 10.0, 10.0]


@pytest.mark.parametrize("number", [0, 1])
def test_a_training_as_a_job_of_a_pack_is_a_client_on_the_gpu_of_its_slot(
    number: int, mps: FakeMps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    here = machine(2, mps_control=mps.program)
    plan = plan_slots(SweepConfig(jobs_per_gpu=2), here, {"auto"})
    job = Process("job", ("true",), tmp_path / "log", is_client=True, memory_fraction=0.5)
    monkeypatch.setattr("gmijax.machine.snapshot.list_gpus", lambda: here.gpus)
    with open_backend(plan, here, SweepPaths(tmp_path / "sweep")) as backend:
        pool = SlotPool([Site(plan, here)])
        slot = next(
            slot
            for _ in range(4)
            if (slot := pool.acquire(1)) and slot.devices == (gpu(number).uuid,)
        )
        for name, value in client_variables(slot, job, backend, here).items():
            monkeypatch.setenv(name, value)
        of_job = detect_machine()
        assert [found.uuid for found in of_job.gpus] == [gpu(number).uuid]
        with open_backend(planned(of_job), of_job, RunPaths(tmp_path / "run")) as own:
            assert own.environment(0)[PIPE_VARIABLE] == str(backend.daemons[gpu(number).uuid])
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "-1")
        assert not detect_machine().gpus
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
        for not_ours in ("", "nope", "[1]"):
            monkeypatch.setenv(DAEMONS_VARIABLE, not_ours)
            assert [found.uuid for found in detect_machine().gpus] == [gpu(0).uuid]
    assert not mps.left()


def test_a_job_with_several_gpus_uses_the_daemons_of_its_sweep(
    mps: FakeMps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    here = machine(2, mps_control=mps.program)
    plan = plan_slots(SweepConfig(jobs_per_gpu=2), here, {"auto"})
    paths, run = SweepPaths(tmp_path / "sweep"), RunPaths(tmp_path / "run")
    monkeypatch.setattr("gmijax.machine.snapshot.list_gpus", lambda: here.gpus)
    with open_backend(plan, here, paths) as backend:
        slot = SlotPool([Site(plan, here)]).acquire(2)
        assert slot is not None
        assert slot.label == "GPU 0 slot 0, GPU 1 slot 0"
        for name, value in variables_of(slot, backend).items():
            monkeypatch.setenv(name, value)
        of_job = detect_machine()
        assert [gpu.uuid for gpu in of_job.gpus] == [gpu(0).uuid, gpu(1).uuid]
        with open_backend(planned(of_job, gpus=2, backend="mps"), of_job, run) as own:
            directories = [own.environment(gmi)[PIPE_VARIABLE] for gmi in (0, 1)]
        assert directories == [backend.environment(gmi)[PIPE_VARIABLE] for gmi in (0, 2)]
        assert (len(mps.commands("start")), len(mps.commands("quit"))) == (2, 0)

        MpsControl(mps.program, Path(directories[1])).quit()
        again = json.loads(variables_of(slot, backend)[DAEMONS_VARIABLE])
        assert again[gpu(0).uuid] == directories[0]
        assert MpsControl(mps.program, Path(again[gpu(1).uuid])).is_answering()
    assert not mps.left()
