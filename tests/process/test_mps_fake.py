"""The mps backend against a fake control program: what it starts, it takes down again."""

from __future__ import annotations

import dataclasses
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from fake_mps import FakeMps
from supervision import TESTS, gpu, machine, make_launch, planned
from training_jobs import wait_until

from gmijax.cluster.node import TrainingNode
from gmijax.collectives.nodes.rendezvous import NodeAddresses
from gmijax.errors import BackendUnavailable, GmiFailed, JobInterrupted
from gmijax.machine.mps_control import PIPE_VARIABLE, MpsControl
from gmijax.machine.nvidia import MigInstance
from gmijax.machine.processes import ProcessId, identify, wait_until_gone
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.supervise.backends import open_backend
from gmijax.supervise.job_kinds import JobKind
from gmijax.supervise.run_gmis import Launch, run_gmis, taking_turns
from gmijax.supervise.stop_signals import StopSignals
from gmijax.supervise.supervisor import Supervisor
from gmijax.supervise.watched_gmi import GmiStatus

pytestmark = pytest.mark.timeout(180)


@pytest.fixture
def mps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeMps:
    return FakeMps(tmp_path, monkeypatch)


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    (tmp_path / "run").mkdir()
    return RunPaths(tmp_path / "run")


def two_clients(mps: FakeMps) -> tuple[Machine, Plan]:
    """A machine with a GPU, and a plan of two GMIs on it."""
    here = machine(1, mps_control=mps.program)
    return here, planned(here, gmis_per_gpu=2, backend="mps")


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
        signals = StopSignals()
        supervisor = Supervisor(make_launch(run, modes, plan), backend, signals=signals)
        stopped: list[bool] = []

        def stop_once(status: tuple[GmiStatus, ...]) -> None:
            if not stopped and all(s.state == "running" for s in status):
                look(directories)
                signals.handle(signal.SIGTERM)
                stopped.append(True)

        with pytest.raises(JobInterrupted, match=r"^stopped$"):
            supervisor.run(stop_once)
    return directories


def test_clients_get_a_private_daemon_per_gpu_that_is_gone_afterwards(mps: FakeMps, run: RunPaths):
    here = machine(2, mps_control=mps.program)
    seen: list[ProcessId | None] = []

    def look(directories: list[Path]) -> None:
        assert all(path.stat().st_mode & 0o777 == 0o700 for path in directories)
        pids = [MpsControl(mps.program, path).daemon_pid() for path in directories]
        seen.extend(identify(pid or 0) for pid in pids)

    plan = planned(here, gpus=2, backend="mps")
    directories = train_and_stop(run, here, plan, ["mps_client", "mps_client"], look)
    assert (run.gmi(0).root / "saved").exists()
    assert [uuid for uuid, _ in mps.commands("start")] == [gpu(0).uuid, gpu(1).uuid]
    assert len(set(seen)) == len(mps.commands("quit")) == 2
    assert not mps.commands("terminate_client")
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


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        ("train", r"GMI 1 failed: its process \d+ is not a client of .*plan\.backend=share$"),
        # Is no client either, and fails a moment later, while the daemon is asked for it.
        ("die_soon", "GMI 1 failed: ended by SIGSEGV"),
    ],
)
def test_gmi_that_is_no_client_is_refused_unless_it_fails_by_itself(
    mode: str, message: str, mps: FakeMps, run: RunPaths
):
    here, plan = two_clients(mps)
    with pytest.raises(GmiFailed, match=message), open_backend(plan, here, run) as backend:
        Supervisor(make_launch(run, ["mps_client", mode], plan), backend).run()
    assert not mps.left()


def test_daemon_that_is_gone_when_shares_are_verified_is_a_failure(mps: FakeMps, run: RunPaths):
    here, plan = two_clients(mps)
    with open_backend(plan, here, run) as backend:
        MpsControl(mps.program, mps.pipe_directories()[0]).quit()
        with pytest.raises(
            GmiFailed, match="GMI 0 failed: cannot ask whether it is an MPS client"
        ):
            backend.verify({0: os.getpid(), 1: os.getpid()})


def test_clients_of_a_daemon_that_was_renewed_are_terminated(mps: FakeMps, run: RunPaths):
    here, plan = two_clients(mps)
    with open_backend(plan, here, run) as backend:
        MpsControl(mps.program, mps.pipe_directories()[0]).quit()
        backend.terminate(0, [os.getpid()])
        backend.renew(1)
        (mps.pipe_directories()[1] / "clients" / str(os.getpid())).touch()
        backend.terminate(1, [os.getpid()])
    assert [int(client) for _, client in mps.commands("terminate_client")] == [os.getpid()]


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
    assert [int(client) for _, client in mps.commands("terminate_client")] == [pids[1]]


def small_job(run: RunPaths, here: Machine, plan: Plan, warnings: list[str]) -> Launch:
    """Its GMIs end at once: `this` is the module of the standard library."""
    write_json(run.plan, plan.to_dict())
    job, kind = make_launch(run, [], plan), JobKind("this")
    return dataclasses.replace(job, machine=here, kind=kind, on_warning=warnings.append)


def test_job_takes_turns_where_no_daemon_can_be_started(
    mps: FakeMps, run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("FAKE_MPS_BROKEN", "1")
    here = machine(1, mps_control=mps.program)
    plan = planned(here, gmis_per_gpu=2)
    assert plan.backend == "mps"
    warnings: list[str] = []
    run_gmis(small_job(run, here, plan, warnings))
    [warning] = warnings
    assert "An instance of this daemon is already running" in warning
    assert "so the GMIs of a GPU take turns; with MPS they were 1.45 to 4.73 times as f" in warning
    written = Plan.from_dict(read_json(run.plan))
    assert (written.backend, written.reasons[-1]) == ("share", warning)
    assert not mps.left()


def test_daemon_that_was_asked_for_and_does_not_start_ends_the_job(
    mps: FakeMps, run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("FAKE_MPS_BROKEN", "1")
    with pytest.raises(BackendUnavailable, match="exit code 1: An instance of this daemon"):
        run_gmis(small_job(run, *two_clients(mps), []))
    assert not mps.left()


def test_gmis_that_share_a_mig_instance_get_a_daemon_for_it(mps: FakeMps, run: RunPaths):
    instances = (
        MigInstance("MIG-large", "3g.71gb", 1, 60, 71424),
        MigInstance("MIG-small", "1g.18gb", 9, 16, 17856),
    )
    divided = gpu(0, mig_enabled=True)._replace(instances=instances)
    here = machine(1, gpus=(divided,), mps_control=mps.program, operator_daemon=Path("/other"))
    plan = planned(here, gmis_per_gpu=3, backend="mig")
    assert [allocation.device for allocation in plan.allocations] == [
        "MIG-large",
        "MIG-small",
        "MIG-large",
    ]
    directories = train_and_stop(run, here, plan, ["mps_client", "train", "mps_client"])
    assert directories[0] == directories[2] != directories[1]
    assert [device for device, _ in mps.commands("start")] == ["MIG-large"]
    assert len(mps.commands("quit")) == 1
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
        plan = planned(here, gmis_per_gpu=2, backend="mps")
        directories = train_and_stop(run, here, plan, ["mps_client", "mps_client"])
        assert set(directories) == {pipe_directory}
        assert len(mps.commands("start")) == 1
        assert not mps.commands("quit")
        assert identify(daemon) is not None
        # A process that it does not know may be of another namespace.
        with (
            open_backend(plan, here, run) as backend,
            pytest.raises(GmiFailed, match=r"GMI 0 failed: .* PID namespace"),
        ):
            backend.verify({0: os.getpid()})
    finally:
        control.quit()


def a_node(here: Machine, monkeypatch: pytest.MonkeyPatch) -> TrainingNode:
    monkeypatch.setattr("gmijax.cluster.node.detect_machine", lambda: here)
    return TrainingNode({}, os.getcwd(), None, "127.0.0.1")


def test_two_nodes_of_one_machine_use_the_daemon_of_the_first(
    mps: FakeMps, run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    here = machine(1, mps_control=mps.program)
    machines = {"a": here, "a#1": here}
    plan = planned(here, nodes=machines, backend="mps")
    launch = make_launch(run, ["mps_client", "mps_client"], plan)
    nodes, daemons, leaders = [a_node(here, monkeypatch) for _ in range(2)], {}, []
    with ExitStack() as held:
        for place, node in enumerate(nodes):
            held.callback(node.close)
            opened = node.open(launch, place, "127.0.0.1", daemons)
            assert not isinstance(opened, BackendUnavailable)
            daemons |= opened.daemons
            leaders.append(opened.leader)
        assert daemons.keys() == {gpu(0).uuid}
        assert len(mps.commands("start")) == 1
        for gmi, node in enumerate(nodes):
            node.set_addresses(NodeAddresses(gmi, tuple(leaders), b"token"))
            pid = node.start(gmi)
            assert isinstance(pid, int)
            deadline_s = time.monotonic() + 30
            while (without := node.verify({gmi: pid})) is not None:
                assert time.monotonic() < deadline_s, without
        failed = nodes[1].verify({1: os.getpid()})
        assert failed is not None
        assert failed[0] == 1
        assert "is not a client of the MPS daemon" in failed[1]
        nodes[1].terminate(1, [pid, os.getpid()])
        assert [int(client) for _, client in mps.commands("terminate_client")] == [pid]
        for gmi, node in enumerate(nodes):
            node.order(gmi, "kill")
            while node.poll()[gmi].exit_code is None:
                time.sleep(0.05)
    assert len(mps.commands("quit")) == 1
    assert not [path for path in mps.pipe_directories() if path.exists()]


def test_a_node_without_a_daemon_says_so_and_takes_turns_when_asked_again(
    mps: FakeMps, run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("FAKE_MPS_BROKEN", "1")
    here = machine(1, mps_control=mps.program)
    plan = planned(here, nodes={"a": here}, gmis_per_gpu=2)
    assert plan.backend == "mps"
    launch = make_launch(run, ["train", "train"], plan)
    with closing(a_node(here, monkeypatch)) as node:
        refused = node.open(launch, 0, "127.0.0.1", {})
        assert isinstance(refused, BackendUnavailable)
        assert isinstance(pickle.loads(pickle.dumps(refused)), BackendUnavailable)
        opened = node.open(taking_turns(launch, refused), 0, "127.0.0.1", {})
        assert not isinstance(opened, BackendUnavailable)
        assert opened.daemons == {}
    assert Plan.from_dict(read_json(run.plan)).backend == "share"


def test_janitor_cleans_up_after_a_killed_controller(mps: FakeMps, run: RunPaths, tmp_path: Path):
    with (tmp_path / "controller.log").open("wb") as log:
        controller = subprocess.Popen(
            [
                *(sys.executable, str(TESTS / "fake_controller.py"), str(run.root), "mps"),
                *("mps_client_in_a_call", "mps_client"),
            ],
            stderr=log,
        )
    try:
        clients = _wait_for_clients(mps, 2)
        [held] = [client.pid for client in clients if b"GMIJAX_GMI=0" in _environment_of(client)]
        [directory] = mps.pipe_directories()
        daemon = identify(MpsControl(mps.program, directory).daemon_pid() or 0)
        assert daemon is not None
    finally:
        controller.kill()
        controller.wait()
    # The held GMI gets 8 s to end by itself before the janitor kills it.
    assert not wait_until_gone([*clients, daemon], timeout_s=90)
    wait_until(lambda: not directory.exists(), 60, "its folder is gone")
    assert len(mps.commands("quit")) == 1
    # The other one has ended by itself.
    assert [int(client) for _, client in mps.commands("terminate_client")] == [held]


def _environment_of(process: ProcessId) -> list[bytes]:
    return Path(f"/proc/{process.pid}/environ").read_bytes().split(b"\0")


def _wait_for_clients(mps: FakeMps, number: int) -> list[ProcessId]:
    clients: list[ProcessId] = []
    while len(clients) < number:
        time.sleep(0.05)
        found = [pid for path in mps.pipe_directories() for pid in (path / "clients").glob("*")]
        clients = [process for path in found if (process := identify(int(path.name)))]
    return clients
