"""The supervisor with real child processes: whatever happens, none of them is left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fake_gmi import has_stopped
from supervision import CHECKOUT, TESTS, cpu_supervisor, machine
from training_jobs import heartbeat_of

from gmijax.errors import ConfigError, GmiFailed, JobInterrupted
from gmijax.machine.processes import ProcessId, identify, wait_until_gone
from gmijax.partition.shares import split_cores
from gmijax.runs.folder import RunPaths, read_json
from gmijax.supervise.backends import Backend
from gmijax.supervise.child import ENV_EXCHANGE_FD
from gmijax.supervise.stop_signals import STOP_SIGNALS, StopSignals
from gmijax.supervise.supervisor import Supervisor
from gmijax.supervise.watched_gmi import GmiStatus

pytestmark = pytest.mark.timeout(120)

Ticks = list[tuple[GmiStatus, ...]]


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    return RunPaths(tmp_path)


def run_job(
    supervisor: Supervisor, act: Callable[[Supervisor, Ticks], None] = lambda _, __: None
) -> Ticks:
    """Runs a job, calls `act` at every tick, checks that no process is left."""
    ticks: Ticks = []

    def on_tick(status: tuple[GmiStatus, ...]) -> None:
        ticks.append(status)
        act(supervisor, ticks)

    try:
        supervisor.run(on_tick)
    finally:
        pids = [status.pid for status in supervisor.status() if status.pid]
        assert not [pid for pid in pids if identify(pid)]
    return ticks


def all_iterate(ticks: Ticks) -> bool:
    return all(status.state in ("running", "stopping") for status in ticks[-1])


def once_all_iterate(act: Callable[[Supervisor, Ticks], None]) -> Callable[..., None]:
    """Acts at the first tick at which all GMIs iterate."""
    acted: list[bool] = []

    def at_tick(supervisor: Supervisor, ticks: Ticks) -> None:
        if all_iterate(ticks) and not acted:
            acted.append(True)
            act(supervisor, ticks)

    return at_tick


def test_one_compiles_alone_and_all_have_their_cores_and_what_they_share(run: RunPaths):
    exchange, hold = os.memfd_create(""), run.root / "hold"
    hold.touch()
    try:
        ticks = run_job(
            cpu_supervisor(run, ["clean", "clean"], {ENV_EXCHANGE_FD: exchange}),
            once_in_states(["compiling", "waiting"], hold.unlink),
        )
        assert os.pread(exchange, 10, 0) == b"xx"
    finally:
        os.close(exchange)
    assert [status.exit_code for status in ticks[-1]] != [None, None]
    assert (run.root / "compiled").read_text() == "1"  # The other one has loaded it.
    cores = split_cores(machine(0).cpu_cores, 2)
    assert [run.gmi(gmi).stdout.read_text().strip() for gmi in (0, 1)] == [
        str(list(own)) for own in cores
    ]


def test_where_another_job_is_killed_as_it_compiles_the_next_one_goes_on(run: RunPaths):
    with start_compiler(run) as compiler:
        run_job(cpu_supervisor(run, ["clean"]), once_in_states(["waiting"], compiler.kill))
    assert (run.root / "compiled").read_text() == "1"
    assert read_json(run.gmi(0).root / "start_s.json")["waiting"] > 0.0


def test_a_gmi_that_waits_for_another_job_ends_with_its_controller(run: RunPaths):
    def fail(_: Supervisor, ticks: Ticks) -> None:
        if ticks[-1][0].state == "waiting":
            raise ZeroDivisionError

    with start_compiler(run) as compiler:
        with pytest.raises(ZeroDivisionError):
            run_job(cpu_supervisor(run, ["clean"], grace=30.0), fail)
        compiler.kill()


def once_in_states(states: list[str], act: Callable[[], object]) -> Callable[..., None]:
    """Acts at the first tick at which GMIs have these states, in any order."""
    acted: list[bool] = []

    def at_tick(_: Supervisor, ticks: Ticks) -> None:
        if sorted(status.state for status in ticks[-1]) == sorted(states) and not acted:
            acted.append(True)
            act()

    return at_tick


def start_compiler(run: RunPaths) -> subprocess.Popen[str]:
    """A process of another job that compiles the program of fake GMIs, and does not end."""
    code = (
        "import sys, time; from pathlib import Path\n"
        "from gmijax.runs.compile_lock import compile_alone\n"
        "def compile():\n    print('compiles', flush=True); time.sleep(600)\n"
        "compile_alone(Path(sys.argv[1]), 'fake', '1', compile)"
    )
    compiler = subprocess.Popen(
        [sys.executable, "-c", code, str(run.root / "cache")],
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert compiler.stdout is not None
    assert compiler.stdout.readline() == "compiles\n"
    return compiler


@pytest.mark.parametrize(
    ("modes", "changes", "message"),
    [
        (["ignore_stop", "exit_3"], {}, "GMI 1 failed: exit code 3: the last line"),
        (
            ["raise_value_error", "ignore_stop"],
            {},
            r"GMI 0 failed: exit code 1: ValueError: the sum is off; by one$",
        ),
        # A GMI that lost its peer does not hide the peer.
        (
            ["lose_peer", "die_late"],
            {},
            "GMI 1 failed: ended by SIGSEGV",
        ),
        (
            ["wait_in_vain", "stall"],
            {},
            r"GMI 1 failed: made no progress after iteration 5; GMI 0 exit code 1: Collective",
        ),
        (
            ["train", "stall"],
            {"stall": 2.0},
            r"GMI 1 failed: made no progress after iteration 5 within 2 s",
        ),
        (
            ["silent", "clean"],
            {"start": 0.5},
            r"GMI 0 failed: did not start and compile within 0.5 s",
        ),
        # One that obeys no order is killed after the grace time.
        (["stubborn", "exit_beside_stopped"], {"grace": 0.5}, "GMI 1 failed: exit code 3"),
    ],
)
def test_the_gmi_that_fails_is_named(
    run: RunPaths, modes: list[str], changes: dict[str, Any], message: str
):
    with pytest.raises(GmiFailed, match=message):
        run_job(cpu_supervisor(run, modes, **changes))
    if "stall" in modes:  # Its threads' stacks are in its log.
        assert "in stall" in run.gmi(1).stderr.read_text()
    if "raise_value_error" in modes:
        assert "ValueError" in read_json(run.gmi(0).error)["traceback"]


def test_bad_input_found_by_a_gmi_is_a_config_error(run: RunPaths):
    with pytest.raises(ConfigError, match=r"^env.name=antt: did you mean ant\?$"):
        run_job(cpu_supervisor(run, ["raise_config_error"]))


def test_killed_gmi_is_named_and_the_others_end(run: RunPaths):
    def kill_second(_: Supervisor, ticks: Ticks) -> None:
        os.kill(ticks[-1][1].pid or 0, signal.SIGKILL)

    with pytest.raises(GmiFailed, match="GMI 1 failed: ended by SIGKILL"):
        run_job(cpu_supervisor(run, ["train", "train", "train"]), once_all_iterate(kill_second))


def test_gmi_that_is_done_but_stays_has_ended_well(run: RunPaths):
    run_job(cpu_supervisor(run, ["linger", "clean"], grace=0.3))


def test_gmis_leave_signals_to_the_controller_and_finish_when_asked(run: RunPaths):
    sent = []

    def send_then_stop(supervisor: Supervisor, ticks: Ticks) -> None:
        if all_iterate(ticks) and not sent:
            sent.extend(status.pid for status in ticks[-1])
            for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGINT):
                for pid in sent:
                    os.kill(pid, number)
        # Their effect would have come by then: both have iterated on.
        if sent and all(status.iteration > 20 for status in ticks[-1]):
            supervisor.ask_to_finish()

    run_job(cpu_supervisor(run, ["train", "train"]), send_then_stop)
    assert all((run.gmi(gmi).root / "saved").exists() for gmi in (0, 1))


def test_missing_program_half_way_ends_those_that_run(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    def lose_python(*_: object) -> None:
        monkeypatch.setattr(sys, "executable", "/no/such/python")

    monkeypatch.setattr(Backend, "started", lose_python)
    with pytest.raises(GmiFailed, match="GMI 1 failed: cannot start /no/such/python: No such"):
        run_job(cpu_supervisor(run, ["ignore_stop", "ignore_stop"]))


@pytest.mark.parametrize(
    ("number", "waits"),
    [
        *((number, True) for number in STOP_SIGNALS if number != signal.SIGINT),
        (signal.SIGINT, False),  # As of roles: what they do has no iterations.
    ],
)
def test_a_signal_lets_gmis_save_and_names_those_that_are_late(
    run: RunPaths, number: int, waits: bool
):
    signals = StopSignals()
    supervisor = cpu_supervisor(
        run, ["train", "ignore_stop"], signals=signals, waits=waits, stop=3.0
    )
    with pytest.raises(JobInterrupted, match=r"GMIs \[1\] did not finish within 3 s"):
        run_job(supervisor, once_all_iterate(lambda *_: signals.handle(number)))
    assert (run.gmi(0).root / "saved").exists()
    assert supervisor.status()[1].state == "stopping"


def test_after_ctrl_c_an_iteration_may_take_longer(run: RunPaths):
    signals, hold, deadline_s = StopSignals(), run.root / "hold_iteration", []
    hold.touch()

    def act(_: Supervisor, ticks: Ticks) -> None:
        if not all_iterate(ticks):
            return
        if not deadline_s:
            signals.handle(signal.SIGINT)
            deadline_s.append(time.monotonic() + 1.0)
        if time.monotonic() > deadline_s[0]:  # Much later than after a SIGTERM.
            hold.unlink(missing_ok=True)

    modes = ["long_iteration", "long_iteration"]
    with pytest.raises(JobInterrupted, match=r"^stopped$"):
        run_job(cpu_supervisor(run, modes, signals=signals, waits=True, stop=0.1), act)
    assert all((run.gmi(gmi).root / "saved").exists() for gmi in (0, 1))


def test_a_gmi_that_hangs_after_ctrl_c_is_named(run: RunPaths):
    signals = StopSignals()
    supervisor = cpu_supervisor(run, ["train", "stall"], signals=signals, waits=True, stall=2.0)
    with pytest.raises(GmiFailed, match="GMI 1 failed: made no progress after iteration 5 within"):
        run_job(supervisor, once_all_iterate(lambda *_: signals.handle(signal.SIGINT)))
    assert (run.gmi(0).root / "saved").exists()


def test_a_signal_of_a_batch_system_after_ctrl_c_does_not_wait(run: RunPaths):
    signals, sent = StopSignals(), []

    def act(_: Supervisor, ticks: Ticks) -> None:
        if all_iterate(ticks) and len(sent) < 2:
            sent.append(signals.handle((signal.SIGINT, signal.SIGTERM)[len(sent)]))

    with pytest.raises(JobInterrupted, match=r"GMIs \[0\] did not finish within 0.5 s"):
        run_job(cpu_supervisor(run, ["ignore_stop"], signals=signals, waits=True, stop=0.5), act)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_request_ends_at_once(
    run: RunPaths, number: int, monkeypatch: pytest.MonkeyPatch
):
    now_s, signals = [100.0], StopSignals()
    monkeypatch.setattr(
        "gmijax.supervise.stop_signals.time", SimpleNamespace(monotonic=lambda: now_s[0])
    )

    def stop_again(_: Supervisor, ticks: Ticks) -> None:
        if all_iterate(ticks):
            signals.handle(number)
            now_s[0] += 2.0

    name = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}[number]
    with pytest.raises(JobInterrupted, match=f"by a second {name}; what was not saved yet"):
        run_job(
            cpu_supervisor(run, ["ignore_stop", "ignore_stop"], signals=signals, waits=True),
            stop_again,
        )


def test_a_signal_while_compiling_ends_at_once(run: RunPaths):
    signals = StopSignals()
    supervisor = cpu_supervisor(run, ["silent", "silent"], signals=signals, waits=True)
    with pytest.raises(JobInterrupted, match="before the work began"):
        run_job(supervisor, lambda *_: signals.handle(signal.SIGINT))


def test_exception_of_the_callback_ends_all(run: RunPaths):
    def fail(_: Supervisor, __: Ticks) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_job(cpu_supervisor(run, ["ignore_stop", "busy"]), once_all_iterate(fail))
    assert identify(read_json(run.gmi(1).root / "helper.json")["pid"]) is None


@pytest.mark.parametrize("is_janitor_stopped", [False, True])
def test_killed_controller_leaves_no_process_and_no_helper_of_a_gmi(
    run: RunPaths, tmp_path: Path, is_janitor_stopped: bool
):
    modes = ["train", "busy", "stubborn"]
    with (tmp_path / "controller.log").open("wb") as log:
        controller = subprocess.Popen(
            [sys.executable, str(TESTS / "fake_controller.py"), str(tmp_path), "cpu", *modes],
            env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
            stderr=log,
        )
    try:
        processes = [_running_gmi(run, gmi) for gmi in range(2)]
        processes.append(_stopped_gmi(run, 2))
        helper = identify(read_json(run.gmi(1).root / "helper.json")["pid"])
        assert helper is not None
        if is_janitor_stopped:
            janitor = _janitor_of(controller.pid)
            os.kill(janitor.pid, signal.SIGSTOP)
            processes.append(janitor)
    finally:
        controller.kill()
        controller.wait()
    assert not wait_until_gone([*processes, helper], timeout_s=90)


def test_a_fork_of_the_controller_does_not_keep_gmis(run: RunPaths):
    code = (
        "import os, time; from gmijax.machine.processes import GuardPipe\n"
        "pipe = GuardPipe()\n"
        "if os.fork() == 0: time.sleep(600)\n"
        "print(pipe.read_end, flush=True); os.read(0, 1)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
    ) as holder:
        assert holder.stdout is not None
        read_end = int(holder.stdout.readline())
        with open(f"/proc/{holder.pid}/fd/{read_end}", "rb") as pipe:
            holder.kill()
            try:
                assert pipe.read() == b""  # Would wait for the fork, if that held it open.
            finally:
                os.killpg(holder.pid, signal.SIGKILL)


def test_a_job_that_is_suspended_as_a_whole_goes_on(run: RunPaths, tmp_path: Path):
    """As by `scontrol suspend`, for longer than GMIs may be silent; the controller comes first."""
    with (tmp_path / "controller.log").open("wb") as log:
        controller = subprocess.Popen(
            [sys.executable, str(TESTS / "fake_controller.py"), str(tmp_path), "cpu", "train"],
            env={**os.environ, "PYTHONPATH": str(CHECKOUT), "FAKE_STALL_S": "4"},
            stderr=log,
        )
    try:
        gmi = _running_gmi(run, 0)
        everybody = [controller.pid, gmi.pid, _janitor_of(controller.pid).pid]
        for pid in everybody:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(8)
        for pid in everybody:
            os.kill(pid, signal.SIGCONT)
            time.sleep(0.5)
        beat = heartbeat_of(run.root, 0)
        assert beat is not None
        while (now := heartbeat_of(run.root, 0)) is None or now.iteration < beat.iteration + 100:
            assert controller.poll() is None, (tmp_path / "controller.log").read_text()
            time.sleep(0.05)
    finally:
        controller.kill()
        controller.wait()
    assert not wait_until_gone([gmi], timeout_s=90)


def _janitor_of(controller: int) -> ProcessId:
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            is_child = f"PPid:\t{controller}\n" in (entry / "status").read_text()
            if is_child and b"gmijax.supervise.janitor" in (entry / "cmdline").read_bytes():
                found = identify(int(entry.name))
                assert found is not None
                return found
    raise AssertionError("no janitor")


def _running_gmi(run: RunPaths, gmi: int) -> ProcessId:
    while True:
        time.sleep(0.02)
        beat = heartbeat_of(run.root, gmi)
        process = identify(beat.pid) if beat and beat.state == "running" else None
        if process is not None:
            return process


def _stopped_gmi(run: RunPaths, gmi: int) -> ProcessId:
    process = _running_gmi(run, gmi)
    while not has_stopped(process.pid):
        time.sleep(0.02)
    return process
