"""The mps backend against a fake control program: what it starts, it takes down again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from supervision import CHECKOUT, TESTS, gpu, machine, make_launch, plan_config, reduce_config
from training_jobs import wait_until

from gmijax.cli.compose import compose
from gmijax.config.sweep import SweepConfig
from gmijax.errors import BackendUnavailable, GmiFailed, JobInterrupted
from gmijax.machine.mps_control import PIPE_VARIABLE, MpsControl
from gmijax.machine.nvidia import MigInstance
from gmijax.machine.processes import ProcessId, identify, wait_until_gone
from gmijax.machine.snapshot import DAEMONS_VARIABLE, Machine, detect_machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.supervise.backends import open_backend
from gmijax.supervise.kinds import JobKind
from gmijax.supervise.launch import Timeouts
from gmijax.supervise.launcher import Launch, StopSignals, run_gmis
from gmijax.supervise.supervisor import Supervisor
from gmijax.supervise.watched_gmi import GmiStatus
from gmijax.sweeps.host import LocalHost, variables_of
from gmijax.sweeps.jobs import SweepPaths, jobs_of
from gmijax.sweeps.places import Places, Site, places_of
from gmijax.sweeps.scheduler import Scheduler
from gmijax.sweeps.study import NoStudy

pytestmark = pytest.mark.timeout(180)


class FakeMps:
    """The fake program and what it was told."""

    def __init__(self, program: Path, journal: Path) -> None:
        self.program = program
        self.journal = journal

    def told(self, command: str) -> list[list[str]]:
        """Arguments of every `command` so far."""
        lines = self.journal.read_text().splitlines() if self.journal.exists() else []
        return [line.split()[1:] for line in lines if line.split()[0] == command]

    def pipe_directories(self) -> list[Path]:
        """Of all daemons that were started."""
        return [Path(directory) for _, directory in self.told("start")]


@pytest.fixture
def mps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeMps:
    folder = tmp_path / "bin"
    folder.mkdir()
    program = folder / "nvidia-cuda-mps-control"
    source = (TESTS / "fake_mps_control.py").read_text()
    program.write_text(f"#!{sys.executable} -IS\n{source}")
    program.chmod(0o755)
    journal = tmp_path / "journal"
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_MPS_JOURNAL", str(journal))
    monkeypatch.setenv("PYTHONPATH", str(CHECKOUT))
    # What is no client by then is none.
    monkeypatch.setattr("gmijax.supervise.backends.mps._CLIENTS_APPEAR_S", 1.0)
    return FakeMps(program, journal)


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    (tmp_path / "run").mkdir()
    return RunPaths(tmp_path / "run")


def mps_plan(here: Machine, num_gpus: int, gmis_per_gpu: int) -> Plan:
    config = plan_config(gpus=num_gpus, gmis_per_gpu=gmis_per_gpu, backend="mps")
    return make_plan(config, reduce_config(), 8, here)


def two_clients(mps: FakeMps) -> tuple[Machine, Plan]:
    """A machine with a GPU, and a plan of two GMIs on it."""
    here = machine(1, mps_control=mps.program)
    return here, mps_plan(here, num_gpus=1, gmis_per_gpu=2)


def train_and_stop(
    run: RunPaths,
    here: Machine,
    plan: Plan,
    modes: list[str],
    look: Callable[[list[Path]], None] = lambda _: None,
) -> list[Path]:
    """Runs a job until all GMIs iterate, then stops it; returns its daemons' directories."""
    with open_backend(plan, here, run) as backend:
        directories = [Path(backend.environment(gmi)[PIPE_VARIABLE]) for gmi in plan.layout.gmis]
        supervisor = Supervisor(make_launch(run, modes, plan), backend)
        stopped: list[bool] = []

        def stop_once(status: tuple[GmiStatus, ...]) -> None:
            if not stopped and all(s.state == "running" for s in status):
                look(directories)
                supervisor.request_stop()
                stopped.append(True)

        with pytest.raises(JobInterrupted, match="every GMI has finished by itself"):
            supervisor.run(stop_once)
    return directories


def test_clients_get_a_private_daemon_per_gpu_that_is_gone_afterwards(mps: FakeMps, run: RunPaths):
    here = machine(2, mps_control=mps.program)
    seen: list[ProcessId | None] = []

    def look(directories: list[Path]) -> None:
        assert all(path.stat().st_mode & 0o777 == 0o700 for path in directories)
        pids = [MpsControl(mps.program, path).daemon_pid() for path in directories]
        seen.extend(identify(pid or 0) for pid in pids)

    plan = mps_plan(here, num_gpus=2, gmis_per_gpu=1)
    directories = train_and_stop(run, here, plan, ["mps_client", "mps_client"], look)
    assert (run.gmi(0).root / "saved").exists()
    assert [uuid for uuid, _ in mps.told("start")] == [gpu(0).uuid, gpu(1).uuid]
    assert len(set(seen)) == len(mps.told("quit")) == 2
    assert not mps.told("terminate_client")
    assert not [process for process in seen if process is None or process.is_running()]
    assert not [path for path in (*directories, run.janitor_log) if path.exists()]


def test_an_interrupted_end_leaves_the_daemons_to_the_janitor(
    mps: FakeMps, run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    def interrupted(_: MpsControl) -> None:
        raise KeyboardInterrupt

    here, plan = two_clients(mps)
    monkeypatch.setattr("gmijax.supervise.backends.mps.quit_daemon", interrupted)
    backend = open_backend(plan, here, run)
    with ExitStack() as held:
        held.enter_context(backend)
        directory = Path(backend.environment(0)[PIPE_VARIABLE])
        daemon = MpsControl(mps.program, directory).daemon_pid()
        process = identify(daemon or 0)
        assert process is not None
        with pytest.raises(KeyboardInterrupt):
            held.close()
    assert not wait_until_gone([process], 90)
    assert not directory.exists()


def test_gmi_that_is_no_client_is_refused(mps: FakeMps, run: RunPaths):
    here, plan = two_clients(mps)
    with (
        pytest.raises(
            GmiFailed,
            match=r"GMI 1 failed: its process \d+ is no client of .*plan\.backend=share$",
        ),
        open_backend(plan, here, run) as backend,
    ):
        Supervisor(make_launch(run, ["mps_client", "train"], plan), backend).run()
    assert not [path for path in mps.pipe_directories() if path.exists()]


def test_gmi_that_fails_while_shares_are_verified_is_the_one_to_blame(mps: FakeMps, run: RunPaths):
    here, plan = two_clients(mps)
    # GMI 1 is no client, fails a moment later, and the daemon is asked for one.
    with (
        pytest.raises(GmiFailed, match="GMI 1 failed: ended by SIGSEGV"),
        open_backend(plan, here, run) as backend,
    ):
        Supervisor(make_launch(run, ["mps_client", "die_late"], plan), backend).run()


def test_daemon_that_is_gone_when_shares_are_verified_is_a_failure(mps: FakeMps, run: RunPaths):
    here, plan = two_clients(mps)
    with open_backend(plan, here, run) as backend:
        MpsControl(mps.program, mps.pipe_directories()[0]).quit()
        with pytest.raises(
            GmiFailed, match="GMI 0 failed: cannot ask whether it is an MPS client"
        ):
            backend.verify({0: os.getpid(), 1: os.getpid()})


def test_clients_are_terminated_before_they_are_killed(mps: FakeMps, run: RunPaths):
    here, plan = two_clients(mps)
    pids: list[int | None] = []

    def kill_first(status: tuple[GmiStatus, ...]) -> None:
        if all(s.state == "running" for s in status) and not pids:
            pids.extend(s.pid for s in status)
            assert pids[0] is not None
            os.kill(pids[0], 9)

    with (
        pytest.raises(GmiFailed, match="GMI 0 failed: ended by SIGKILL"),
        open_backend(plan, here, run) as backend,
    ):
        Supervisor(make_launch(run, ["mps_client", "mps_client"], plan), backend).run(kill_first)
    assert [int(client) for _, client in mps.told("terminate_client")] == [pids[1]]


def small_job(run: RunPaths, here: Machine, plan: Plan, told: list[str]) -> Launch:
    """Its GMIs end at once: `this` is the module of the standard library."""
    write_json(run.plan, plan.to_dict())
    timeouts = Timeouts(start_timeout_s=90, stall_timeout_s=90, stop_timeout_s=90, grace_s=2)
    return Launch(
        plan=plan,
        machine=here,
        run=run,
        kind=JobKind("this"),
        timeouts=timeouts,
        on_warning=told.append,
    )


def test_job_takes_turns_where_no_daemon_can_be_started(
    mps: FakeMps, run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("FAKE_MPS_BROKEN", "1")
    here = machine(1, mps_control=mps.program)
    plan = make_plan(plan_config(gmis_per_gpu=2), reduce_config(), 8, here)
    assert plan.backend == "mps"
    told: list[str] = []
    run_gmis(small_job(run, here, plan, told))
    [warning] = told
    assert "An instance of this daemon is already running" in warning
    assert warning.endswith("so the GMIs of a GPU take turns; with MPS they were 2.0 to 2.9 times "
                            "as fast")  # fmt: skip
    written = Plan.from_dict(read_json(run.plan))
    assert (written.backend, written.reasons[-1]) == ("share", warning)
    assert not [path for path in mps.pipe_directories() if path.exists()]


def test_daemon_that_was_asked_for_and_does_not_start_ends_the_job(
    mps: FakeMps, run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("FAKE_MPS_BROKEN", "1")
    with pytest.raises(BackendUnavailable, match="exit code 1: An instance of this daemon"):
        run_gmis(small_job(run, *two_clients(mps), []))
    assert not [path for path in mps.pipe_directories() if path.exists()]


def test_gmis_that_share_a_mig_instance_get_a_daemon_for_it(mps: FakeMps, run: RunPaths):
    instances = (
        MigInstance("MIG-large", "3g.71gb", 1, 60, 71424),
        MigInstance("MIG-small", "1g.18gb", 9, 16, 17856),
    )
    divided = gpu(0, mig_enabled=True)._replace(instances=instances)
    here = machine(1, gpus=(divided,), mps_control=mps.program, operator_daemon=Path("/other"))
    config = plan_config(gmis_per_gpu=3, backend="mig")
    plan = make_plan(config, reduce_config(), 8, here)
    assert [share.device for share in plan.slices] == ["MIG-large", "MIG-small", "MIG-large"]
    directories = train_and_stop(run, here, plan, ["mps_client", "train", "mps_client"])
    assert directories[0] == directories[2] != directories[1]
    assert [device for device, _ in mps.told("start")] == ["MIG-large"]
    assert len(mps.told("quit")) == 1
    assert not directories[0].exists()


def test_daemon_of_somebody_else_is_used_and_left_alone(
    mps: FakeMps, run: RunPaths, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pipe_directory = tmp_path / "operator"
    pipe_directory.mkdir()
    control = MpsControl(mps.program, pipe_directory)
    control.start(gpu(0).uuid, tmp_path / "operator-logs")
    daemon = control.daemon_pid()
    assert daemon is not None
    monkeypatch.setenv(PIPE_VARIABLE, str(pipe_directory))
    monkeypatch.setattr("gmijax.machine.snapshot.list_gpus", lambda: (gpu(0),))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    try:
        here = detect_machine()
        assert here.operator_daemon == pipe_directory
        plan = mps_plan(here, num_gpus=1, gmis_per_gpu=2)
        directories = train_and_stop(run, here, plan, ["mps_client", "mps_client"])
        assert set(directories) == {pipe_directory}
        assert len(mps.told("start")) == 1
        assert not mps.told("quit")
        assert identify(daemon) is not None
        # A stranger to it may be of another namespace.
        with (
            open_backend(plan, here, run) as backend,
            pytest.raises(GmiFailed, match=r"GMI 0 failed: .* PID namespace"),
        ):
            backend.verify({0: os.getpid()})
    finally:
        control.quit()


def test_a_fatal_fault_ends_one_job_of_a_sweep_and_its_neighbours_go_on(
    mps: FakeMps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("gmijax.sweeps.children.MODULE", "fake_training_job")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", f"{CHECKOUT}{os.pathsep}{TESTS}")
    here = machine(2, mps_control=mps.program)
    # Of programs of their own, so that none waits for another one to compile.
    jobs = list(jobs_of([compose(f"seed={n}", f"num_envs={n + 1}") for n in range(6)]))
    settings, paths = SweepConfig(jobs_per_gpu=3), SweepPaths(tmp_path)
    plan = places_of(settings, here, {"auto"})
    with closing(LocalHost(here)) as host:
        host.open(plan, paths)
        places = Places([Site(plan, here)])
        scheduler = Scheduler(jobs, NoStudy(), settings, paths, places, [host], lambda: None)
        scheduler.run(StopSignals())
    states = [job.progress.state for job in jobs]
    assert states == ["completed", "failed", *["completed"] * 4]
    assert "CUDA_ERROR_LAUNCH_FAILED" in str(jobs[1].progress.error)
    starts = [(paths.job(n).root / "starts").read_text().splitlines() for n in range(6)]
    assert [len(lines) for lines in starts] == [1, 2, 1, 2, 1, 2]
    # From their checkpoints, and nobody beside them: it could be the fault of each.
    assert {starts[n][1] for n in (1, 3, 5)} == {"from step 5 beside 0"}
    assert [job.progress.value for job in jobs] == [10.0, 5.0, 10.0, 10.0, 10.0, 10.0]


def test_a_job_with_several_gpus_uses_the_daemons_of_its_sweep(
    mps: FakeMps, run: RunPaths, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    here = machine(2, mps_control=mps.program)
    settings = SweepConfig(jobs_per_gpu=2)
    plan = places_of(settings, here, {"auto"})
    paths = SweepPaths(tmp_path / "sweep")
    monkeypatch.setattr("gmijax.machine.snapshot.list_gpus", lambda: here.gpus)
    with open_backend(plan, here, paths) as backend:
        place = Places([Site(plan, here)]).take(2)
        assert place is not None
        assert place.label == "GPU 0 place 0, GPU 1 place 0"
        for name, value in variables_of(place, backend).items():
            monkeypatch.setenv(name, value)
        of_job = detect_machine()
        assert [gpu.uuid for gpu in of_job.gpus] == [gpu(0).uuid, gpu(1).uuid]
        with open_backend(mps_plan(of_job, num_gpus=2, gmis_per_gpu=1), of_job, run) as own:
            directories = [own.environment(gmi)[PIPE_VARIABLE] for gmi in (0, 1)]
        assert directories == [backend.environment(gmi)[PIPE_VARIABLE] for gmi in (0, 2)]
        assert (len(mps.told("start")), len(mps.told("quit"))) == (2, 0)

        MpsControl(mps.program, Path(directories[1])).quit()
        again = json.loads(variables_of(place, backend)[DAEMONS_VARIABLE])
        assert again[gpu(0).uuid] == directories[0]
        assert MpsControl(mps.program, Path(again[gpu(1).uuid])).is_answering()
    assert not [path for path in mps.pipe_directories() if path.exists()]


def test_janitor_cleans_up_after_a_killed_controller(mps: FakeMps, run: RunPaths, tmp_path: Path):
    with (tmp_path / "controller.log").open("wb") as log:
        controller = subprocess.Popen(
            [
                *(sys.executable, str(TESTS / "fake_controller.py"), str(run.root), "mps"),
                *("mps_client", "mps_client"),
            ],
            stderr=log,
        )
    try:
        clients = _wait_for_clients(mps, 2)
        [directory] = mps.pipe_directories()
        daemon = identify(MpsControl(mps.program, directory).daemon_pid() or 0)
        assert daemon is not None
        os.kill(clients[0].pid, signal.SIGSTOP)
    finally:
        controller.kill()
        controller.wait()
    # The stopped GMI gets 8 s to end by itself before the janitor kills it.
    assert not wait_until_gone([*clients, daemon], timeout_s=90)
    wait_until(lambda: not directory.exists(), 60, "its folder is gone")
    assert len(mps.told("quit")) == 1
    # The other one has ended by itself.
    assert [int(client) for _, client in mps.told("terminate_client")] == [clients[0].pid]


def _wait_for_clients(mps: FakeMps, number: int) -> list[ProcessId]:
    clients: list[ProcessId] = []
    while len(clients) < number:
        time.sleep(0.05)
        found = [pid for path in mps.pipe_directories() for pid in (path / "clients").glob("*")]
        clients = [process for path in found if (process := identify(int(path.name)))]
    return clients
