"""The supervisor with real child processes: whatever happens, none of them is left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from supervision import CHECKOUT, TESTS, cpu_job
from training_jobs import heartbeat_of

from gmijax.errors import ConfigError, GmiFailed, JobInterrupted
from gmijax.machine.processes import ProcessId, identify, wait_until_gone
from gmijax.runs.folder import RunPaths, read_json
from gmijax.supervise.child import ENV_EXCHANGE_FD
from gmijax.supervise.gmi_process import GmiStatus
from gmijax.supervise.supervisor import Job, Supervisor

pytestmark = pytest.mark.timeout(30)

Ticks = list[tuple[GmiStatus, ...]]


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    return RunPaths(tmp_path)


def run_job(job: Job, act: Callable[[Supervisor, Ticks], None] = lambda _, __: None) -> Ticks:
    """Runs a job, calls `act` at every tick, checks that no process is left."""
    supervisor = Supervisor(job)
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
    return all(status.state == "running" for status in ticks[-1])


def test_clean_end_reports_progress_and_lets_the_first_compile_alone(run: RunPaths):
    ticks = run_job(cpu_job(run, ["clean", "clean"]))
    assert [status.state for status in ticks[0]] == ["starting", "waiting"]
    first_of_second = next(tick for tick in ticks if tick[1].state != "waiting")
    assert first_of_second[0].state in ("ready", "running", "done")
    assert [status.exit_code for status in ticks[-1]] != [None, None]


def test_all_start_together_without_compile_once(run: RunPaths):
    ticks = run_job(cpu_job(run, ["clean", "clean"], compile_once=False))
    assert all(status.pid for status in ticks[0])


def test_failing_gmi_is_named_with_exit_code_and_last_line(run: RunPaths):
    with pytest.raises(GmiFailed, match="GMI 1 failed: exit code 3: the last line"):
        run_job(cpu_job(run, ["deaf", "exit_3", "deaf"]))


def test_failing_gmi_is_named_with_its_own_error(run: RunPaths):
    with pytest.raises(GmiFailed, match=r"GMI 0 failed: exit code 1: ValueError: the sum is off$"):
        run_job(cpu_job(run, ["raise_value_error", "deaf"]))
    assert "ValueError" in read_json(run.gmi(0).error)["traceback"]


def test_bad_input_found_by_a_gmi_is_a_config_error(run: RunPaths):
    with pytest.raises(ConfigError, match=r"^env.name=antt: did you mean ant\?$"):
        run_job(cpu_job(run, ["raise_config_error"]))


def test_killed_gmi_is_named_and_the_others_end_within_seconds(run: RunPaths):
    killed_s: list[float] = []

    def kill_second(supervisor: Supervisor, ticks: Ticks) -> None:
        pid = ticks[-1][1].pid
        if all_iterate(ticks) and pid and not killed_s:
            os.kill(pid, signal.SIGKILL)
            killed_s.append(time.monotonic())

    with pytest.raises(GmiFailed, match="GMI 1 failed: ended by SIGKILL"):
        run_job(cpu_job(run, ["train", "train", "train"]), kill_second)
    assert time.monotonic() - killed_s[0] < 20  # Not by a time limit of the job.


def test_gmi_that_lost_its_peer_does_not_hide_the_peer(run: RunPaths):
    with pytest.raises(GmiFailed, match="GMI 1 failed: ended by SIGSEGV"):
        run_job(cpu_job(run, ["lose_peer", "die_late"], compile_once=False))


def test_gmi_that_others_wait_for_in_vain_is_named_and_leaves_its_stacks(run: RunPaths):
    message = r"GMI 1 failed: made no progress after iteration 5; GMI 0 exit code 1: Collective"
    with pytest.raises(GmiFailed, match=message):
        run_job(cpu_job(run, ["wait_in_vain", "stall"], compile_once=False))
    assert "in stall" in run.gmi(1).stderr.read_text()


def test_gmi_that_hears_no_order_is_killed_after_the_grace_time(run: RunPaths):
    with pytest.raises(GmiFailed, match="GMI 1"):
        run_job(cpu_job(run, ["stubborn", "exit_3"], grace=0.5, stall=30))
    assert (run.gmi(0).root / "stopping").exists()


def test_gmi_that_is_done_but_stays_has_ended_well(run: RunPaths):
    run_job(cpu_job(run, ["linger", "clean"], grace=0.3))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGINT])
def test_gmis_leave_signals_to_the_controller(run: RunPaths, number: signal.Signals):
    sent = []

    def send_then_stop(supervisor: Supervisor, ticks: Ticks) -> None:
        if all_iterate(ticks) and not sent:
            sent.extend(status.pid for status in ticks[-1])
            for pid in sent:
                os.kill(pid, number)
        # Its effect would have come by then: both have iterated on.
        if sent and all(status.iteration > 20 for status in ticks[-1]):
            supervisor.ask_to_finish()

    run_job(cpu_job(run, ["train", "train"]), send_then_stop)
    assert all((run.gmi(gmi).root / "saved").exists() for gmi in (0, 1))


def test_gmi_without_progress_leaves_the_stacks_of_its_threads(run: RunPaths):
    with pytest.raises(GmiFailed, match="made no progress after iteration 5"):
        run_job(cpu_job(run, ["stall"], stall=0.5))
    assert "in stall" in run.gmi(0).stderr.read_text()


def test_gmi_that_never_beats_fails_the_start(run: RunPaths):
    with pytest.raises(GmiFailed, match=r"GMI 0 failed: did not start and compile within 0.5 s"):
        run_job(cpu_job(run, ["silent", "clean"], start=0.5))


def test_gmi_without_progress_fails(run: RunPaths):
    with pytest.raises(
        GmiFailed, match=r"GMI 1 failed: made no progress after iteration 5 within 0.5 s"
    ):
        run_job(cpu_job(run, ["train", "stall"], stall=0.5))


def test_missing_program_half_way_ends_those_that_run(run: RunPaths):
    good = cpu_job(run, ["deaf", "deaf"]).command

    def command(gmi: int) -> list[str]:
        return list(good(gmi)) if gmi == 0 else ["/no/such/python"]

    with pytest.raises(GmiFailed, match="GMI 1 failed: cannot start /no/such/python: No such"):
        run_job(cpu_job(run, ["deaf", "deaf"], command=command))


def test_stop_request_lets_all_finish_and_save(run: RunPaths):
    stopped: list[bool] = []

    def stop_once(supervisor: Supervisor, ticks: Ticks) -> None:
        if not stopped and all_iterate(ticks):
            supervisor.request_stop()
            stopped.append(True)

    with pytest.raises(JobInterrupted, match="every GMI has finished by itself"):
        run_job(cpu_job(run, ["train", "train"]), stop_once)
    assert all((run.gmi(gmi).root / "saved").exists() for gmi in (0, 1))


def test_second_stop_request_ends_at_once(run: RunPaths):
    def stop_again(supervisor: Supervisor, ticks: Ticks) -> None:
        if all_iterate(ticks):
            supervisor.request_stop()

    with pytest.raises(JobInterrupted, match="second request"):
        run_job(cpu_job(run, ["deaf", "deaf"]), stop_again)


def test_gmi_that_does_not_stop_in_time_is_named(run: RunPaths):
    stopped: list[bool] = []

    def stop_once(supervisor: Supervisor, ticks: Ticks) -> None:
        if not stopped and all_iterate(ticks):
            supervisor.request_stop()
            stopped.append(True)

    with pytest.raises(JobInterrupted, match=r"GMIs \[1\] did not finish within 0.5 s"):
        run_job(cpu_job(run, ["train", "deaf"], stop=0.5), stop_once)


def test_stop_request_while_compiling_ends_at_once(run: RunPaths):
    def stop(supervisor: Supervisor, ticks: Ticks) -> None:
        supervisor.request_stop()

    with pytest.raises(JobInterrupted):
        run_job(cpu_job(run, ["silent", "silent"]), stop)


def test_exception_of_the_callback_ends_all(run: RunPaths):
    def fail(supervisor: Supervisor, ticks: Ticks) -> None:
        if all_iterate(ticks):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_job(cpu_job(run, ["deaf", "busy"]), fail)
    assert identify(read_json(run.gmi(1).root / "helper.json")["pid"]) is None


def test_exchange_file_reaches_every_gmi(run: RunPaths):
    exchange = os.memfd_create("")
    code = (
        "import os; from gmijax.supervise.child import ChildLink;"
        "link = ChildLink.from_environment();"
        "os.pwrite(link.exchange_fd, b'x', link.gmi)"
    )
    try:
        run_job(
            cpu_job(
                run,
                ["clean"] * 3,
                command=lambda gmi: [sys.executable, "-c", code],
                inherited_fds={ENV_EXCHANGE_FD: exchange},
            )
        )
        assert os.pread(exchange, 10, 0) == b"xxx"
    finally:
        os.close(exchange)


def test_gmi_is_pinned_to_its_cores(run: RunPaths):
    code = (
        "import os; from gmijax.supervise.child import ChildLink;"
        "ChildLink.from_environment(); print(sorted(os.sched_getaffinity(0)))"
    )
    job = cpu_job(run, ["clean"] * 2, command=lambda gmi: [sys.executable, "-c", code])
    run_job(job)
    for gmi in (0, 1):
        cores = [int(core) for core in job.environment(gmi)["GMIJAX_CPUS"].split(",")]
        assert run.gmi(gmi).stdout.read_text().strip() == str(cores)


def test_killed_controller_leaves_no_process_and_no_helper_of_a_gmi(run: RunPaths, tmp_path: Path):
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
    finally:
        controller.kill()
        controller.wait()
    assert not wait_until_gone([*processes, helper], timeout_s=40)


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


def _running_gmi(run: RunPaths, gmi: int) -> ProcessId:
    while True:
        time.sleep(0.02)
        beat = heartbeat_of(run.root, gmi)
        process = identify(beat.pid) if beat and beat.state == "running" else None
        if process is not None:
            return process


def _stopped_gmi(run: RunPaths, gmi: int) -> ProcessId:
    process = _running_gmi(run, gmi)
    while b") T " not in Path(f"/proc/{process.pid}/stat").read_bytes():
        time.sleep(0.02)
    return process
