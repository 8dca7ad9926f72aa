"""Faults of a sweep without processes: killed controllers, a full disk, refused commands."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from supervision import machine
from test_sweep_nodes import Sweep, jobs

from gmijax.cli.command import sweep_command
from gmijax.cli.compose import compose
from gmijax.clock import running_s
from gmijax.config.sweep import SweepConfig
from gmijax.errors import ConfigError, GmijaxError, JobInterrupted, JobNotStarted
from gmijax.machine.processes import identify
from gmijax.runs.folder import read_json
from gmijax.runs.held import OpenFolder, is_locked, locked, try_lock
from gmijax.supervise import janitor
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps import held_jobs, report, scheduler
from gmijax.sweeps.children import Child, Process
from gmijax.sweeps.host import ChildStart, LocalHost
from gmijax.sweeps.jobs import Job, jobs_of
from gmijax.sweeps.kind import JobStart
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.report import JobsReport
from gmijax.sweeps.slots import Site, Slot, SlotPool, plan_slots
from gmijax.sweeps.study import Study
from gmijax.sweeps.training import TrainingKind


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "_TICK_S", 0.0)


@pytest.mark.parametrize(
    ("exit_code", "reason"),
    [
        (-9, "its controller was killed by SIGKILL"),
        (-11, "its controller was killed by SIGSEGV"),
        (130, "a signal from elsewhere interrupted it"),  # By a SIGTERM to this job alone.
    ],
)
def test_a_job_whose_controller_is_killed_runs_again(
    exit_code: int, reason: str, tmp_path: Path
) -> None:
    sweep = Sweep(tmp_path, jobs(2))
    sweep.run(lambda: sweep.nodes[0].end(exit_code), sweep.end_all)
    assert sweep.states() == ["completed"] * 2
    (event,) = map(json.loads, sweep.paths.job(0).events.read_text().splitlines())
    assert event["reason"] == f"again, after {reason}"
    (tmp_path / "once").mkdir()
    once = Sweep(tmp_path / "once", jobs(1, "run.max_restarts=1"))
    once.run(lambda: once.nodes[0].end(exit_code), lambda: once.nodes[0].end(exit_code))
    assert (once.states(), once.jobs[0].progress.error) == (["failed"], reason)


def full(*_: Any, **__: Any) -> Any:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "some/file")


class FullStudy(Study[Job]):
    """Cannot be written when a job is added to it, or when it is asked about one."""

    tell = full
    is_hopeless = full


@pytest.mark.parametrize("what", ["a job that cannot start", "a study that cannot be written"])
def test_a_sweep_that_cannot_write_asks_running_jobs_to_save(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = Sweep(tmp_path, jobs(6))
    orders = orders_of(sweep, monkeypatch)

    def fill() -> None:
        sweep.nodes[1].end()
        for node in sweep.nodes:
            monkeypatch.setattr(node, "start", full)

    if "study" in what:
        monkeypatch.setattr("test_sweep_nodes.Study", FullStudy)
    with pytest.raises(OSError, match="No space left"):
        sweep.run(fill)
    assert "ask_to_stop" in orders
    assert "kill" not in orders
    states = sweep.states()
    assert "running" not in states
    assert "interrupted" in states


def orders_of(
    sweep: Sweep, monkeypatch: pytest.MonkeyPatch, ignored: Collection[str] = ()
) -> list[str]:
    """The orders to jobs from now on; the orders in `ignored` have no effect."""
    orders: list[str] = []
    for node in sweep.nodes:

        def order(child: int, do: Any, old: Any = node.order) -> None:
            orders.append(do)
            if do not in ignored:
                old(child, do)

        monkeypatch.setattr(node, "order", order)
    return orders


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ([signal.SIGINT], ["interrupt"]),
        ([signal.SIGTERM], ["ask_to_stop"]),
        ([signal.SIGINT, signal.SIGHUP], ["interrupt", "ask_to_stop"]),
        ([signal.SIGUSR1, signal.SIGINT], ["ask_to_stop"]),
    ],
)
def test_jobs_are_asked_once_and_once_more_if_it_becomes_urgent(
    numbers: list[int], expected: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep, signals = Sweep(tmp_path, jobs(1)), StopSignals()
    orders = orders_of(sweep, monkeypatch, ignored=("interrupt", "ask_to_stop"))

    def wait() -> None: ...

    def end() -> None:
        for node in sweep.nodes:
            node.end(130)

    steps = [part for number in numbers for part in (partial(signals.handle, number), wait)]
    with pytest.raises(JobInterrupted):
        sweep.run(*steps, wait, end, signals=signals)
    assert orders == [*expected, "close"]
    assert sweep.states() == ["interrupted"]


@pytest.mark.parametrize(
    ("exit_code", "state"),
    [(-signal.SIGINT, "interrupted"), (-signal.SIGTERM, "interrupted"), (-9, "waiting")],
)
def test_a_controller_that_is_asked_before_it_handles_signals_is_interrupted(
    exit_code: int, state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep, signals = Sweep(tmp_path, jobs(1)), StopSignals()
    orders_of(sweep, monkeypatch, ignored=("interrupt", "ask_to_stop"))
    end = partial(sweep.nodes[0].end, exit_code)
    with pytest.raises(JobInterrupted):
        sweep.run(partial(signals.handle, signal.SIGINT), end, signals=signals)
    assert sweep.states() == [state]


def test_jobs_that_cannot_be_ranked_are_ended_at_their_first_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = Sweep(tmp_path, jobs(6), objective="metric/distnace")
    orders = orders_of(sweep, monkeypatch)

    def report() -> None:
        with sweep.paths.job(1).metrics.open("a") as file:
            file.write(json.dumps({"env_steps": 9, "metric/distance": None}) + "\n")

    with pytest.raises(ConfigError, match="did you mean metric/distance"):
        sweep.run(report)
    assert orders.count("ask_to_stop") == 4  # Those of all slots.
    assert "kill" not in orders
    assert sweep.states() == ["interrupted"] * 4 + ["waiting"] * 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_only_urgent_signals_give_jobs_a_time_to_end(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep, signals = Sweep(tmp_path, jobs(1)), StopSignals()
    orders = orders_of(sweep, monkeypatch, ignored=("interrupt", "ask_to_stop"))
    clock_s = [running_s()]
    monkeypatch.setattr("gmijax.sweeps.running.running_s", lambda: clock_s[0])

    def later() -> None:
        clock_s[0] += 10_000.0

    def end() -> None:
        for node in sweep.nodes:
            node.end(130)

    with pytest.raises(JobInterrupted):
        sweep.run(partial(signals.handle, number), later, later, end, signals=signals)
    assert ("kill" in orders) == (number == signal.SIGTERM)


def test_a_command_is_asked_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It knows no urgency, and what a second signal does to it is not known."""
    process = Process("job", ("sleep", "600"), tmp_path / "log", is_client=True)
    child, sent = Child(process, {}), []
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "killpg", lambda _, number: sent.append(number))
            child.interrupt()
            child.ask_to_stop()
        assert sent == [signal.SIGTERM]
    finally:
        child.close()


WITHOUT_LOCK = (
    *(sys.executable, "-ISc"),
    "import os, time; os.closerange(3, 256); time.sleep(600)",
)
"""As `sudo` does."""


@pytest.mark.parametrize("is_client", [True, False])
def test_a_job_that_cannot_be_killed_is_named_and_holds_up_no_other(
    is_client: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths, host, made = SweepPaths(tmp_path), LocalHost(machine(0)), list[Child]()
    monkeypatch.setattr(
        "gmijax.sweeps.host.Child", lambda *given: made.append(Child(*given)) or made[-1]
    )
    plan = plan_slots(SweepConfig(jobs_per_gpu=2), host.machine, {"auto"})
    slots = SlotPool([Site(plan, host.machine)])
    host.open(plan, paths)
    of_both = jobs(2)
    for number, job in enumerate(of_both):
        lock, job.progress.attempts = paths.job(number).lock, 1
        lock.parent.mkdir()
        log = paths.job(number).root / "log"
        process = Process("job", WITHOUT_LOCK, log, is_client=is_client, lock=lock)
        slot = slots.acquire(1)
        assert slot is not None
        host.start(ChildStart(slot, process))
        while is_locked(lock):
            time.sleep(0.01)
    pids = [child.pid for child in made]
    try:
        with monkeypatch.context() as patch:
            for name in ("kill", "killpg"):
                patch.setattr(os, name, forbidden(pids[0], getattr(os, name)))
            patch.setattr("gmijax.sweeps.children._KILLED_S", 0.2)
            host.order(1, "ask_to_stop")
            host.close()
        assert made[1].look().exit_code == -signal.SIGKILL
        (message,) = held_jobs.left_behind(of_both, paths, host.left)
        assert message.startswith(f"job 0: process {pids[0]} (")
        assert message.endswith(f"still runs in its folder: end it (kill {pids[0]})")
    finally:
        for child in made:
            child.kill()
            while child.look().exit_code is None:
                time.sleep(0.01)
    assert held_jobs.left_behind(of_both, paths, host.left) == []


def forbidden(pid: int, send: Callable[[int, int], None]) -> Callable[[int, int], None]:
    """Sends signals to all but one process, which is as if it were another user's."""

    def sent(to: int, number: int) -> None:
        if to == pid:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
        send(to, number)

    return sent


def test_a_group_that_cannot_be_killed_does_not_save_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    command = ("sleep", "600")
    processes = [subprocess.Popen(command, start_new_session=True) for _ in range(2)]
    known = [identify(process.pid) for process in processes]
    groups = {process.pid: {process} for process in known if process is not None}
    monkeypatch.setattr(janitor, "_DAEMON_ENDS_S", 0.2)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "killpg", forbidden(processes[0].pid, os.killpg))
            janitor._kill(groups, ())
        assert [process.wait(10) for process in processes[1:]] == [-signal.SIGKILL]
        assert processes[0].poll() is None
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_an_order_that_cannot_be_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.sweeps.children.write_json", full)
    before = set(os.listdir("/proc/self/fd"))
    order = tmp_path / "003.json", {}
    process = Process("job 003", ("true",), tmp_path / "003.log", input_file=order)
    with pytest.raises(GmijaxError, match=r"^job 003: cannot be started \(No space left"):
        Child(process, {})
    # Not fewer either: garbage of other tests is collected at any moment.
    assert set(os.listdir("/proc/self/fd")) <= before


@pytest.mark.parametrize(
    ("arguments", "cwd", "reason"),
    [
        (("./alien",), None, "./alien: Exec format error"),
        (("./no_x",), None, "./no_x: Permission denied"),
        (("./gone",), None, "./gone: No such file or directory"),
        (("true",), "./nowhere", "working folder ./nowhere: No such file or directory"),
        (("true", "\0"), None, "embedded null byte"),
        (("true", "x" * 2**20), None, "true: Argument list too long"),
    ],
)
def test_what_is_wrong_with_one_command_is_named_and_is_no_error_of_all(
    arguments: tuple[str, ...],
    cwd: str | None,
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "alien").write_bytes(b"\x7fELF of nothing")
    (tmp_path / "alien").chmod(0o755)
    (tmp_path / "no_x").touch()
    before = set(os.listdir("/proc/self/fd"))
    lock = tmp_path / ".lock"
    with pytest.raises(JobNotStarted) as raised:
        Child(Process("job 003", arguments, tmp_path / "log", cwd=cwd, lock=lock), {})
    assert str(raised.value) == f"cannot be started ({reason})"
    assert not is_locked(lock)
    assert set(os.listdir("/proc/self/fd")) <= before


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM])
def test_what_no_job_can_have_is_an_error_of_all(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Any, **__: Any) -> Any:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(subprocess, "Popen", refused)
    with pytest.raises(GmijaxError, match=r"^job 003: cannot be started \(") as raised:
        Child(Process("job 003", ("true",), tmp_path / "log"), {})
    assert not isinstance(raised.value, JobNotStarted)


class OddFiles(TrainingKind):
    """Two jobs have files that cannot be opened."""

    def start(self, jobs: tuple[Job, ...], slot: Slot) -> JobStart:
        if jobs[0].number in (1, 2):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "some/file")
        return super().start(jobs, slot)


@pytest.mark.parametrize("where", ["its files", "its process"])
def test_a_job_that_cannot_be_started_fails_alone(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = Sweep(tmp_path, jobs(8))
    orders = orders_of(sweep, monkeypatch)
    for node in sweep.nodes:

        def begin(start: ChildStart, old: Any = node.start) -> int:
            if where == "its process" and start.process.name in ("job 001", "job 002"):
                raise JobNotStarted("cannot be started (odd)")
            return old(start)

        monkeypatch.setattr(node, "start", begin)
    sweep.run(sweep.end_all, kind=OddFiles if where == "its files" else TrainingKind)
    assert sweep.states() == ["completed", "failed", "failed", *["completed"] * 5]
    assert all("cannot be started (" in (job.progress.error or "") for job in sweep.jobs[1:3])
    assert set(orders) == {"close"}
    assert sweep.slots.num_gpus_with_free_slot() == 2  # Those of the failed ones are free again.


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process that an earlier command has left in the folder of job 1."""
    lock = SweepPaths(tmp_path).job(1).lock
    lock.parent.mkdir()
    fd = try_lock(lock)
    assert fd is not None
    process = subprocess.Popen(["sleep", "600"], pass_fds=(fd,))
    os.close(fd)
    yield process
    process.kill()
    process.wait()


def test_a_job_whose_folder_a_process_holds_waits_and_then_fails(
    holder: subprocess.Popen[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock_s, notes = [0.0], set[str]()
    monkeypatch.setattr(held_jobs, "running_s", lambda: clock_s[0])
    sweep = Sweep(tmp_path, jobs(6))

    def later() -> None:
        clock_s[0] += 50.0
        notes.add(sweep.jobs[1].progress.note or "")
        if clock_s[0] > 400.0:  # Until then others run.
            sweep.end_all()
        if len(sweep.nodes[0].running) + len(sweep.nodes[1].running):
            assert sweep.jobs[1].progress.state == "waiting"

    sweep.run(later)
    assert sweep.states() == ["completed", "failed", *["completed"] * 4]
    what = f"process {holder.pid} (sleep), started earlier, still runs in its folder: end it (kill"
    assert sweep.jobs[1].progress.error == f"{what} {holder.pid}), then give the same command"
    (note,) = notes - {""}
    assert note.startswith(f"{what} {holder.pid}); the job fails if that still runs after 120 s")
    assert 1 not in [number for node in sweep.nodes for number in node.started]


def free_later(sweep: Sweep, holder: subprocess.Popen[bytes], clock_s: list[float]) -> None:
    """Runs a sweep, and ends what holds the folder of its job 1 after 50 s."""

    def later() -> None:
        clock_s[0] += 10.0
        sweep.end_all()
        if clock_s[0] == 50.0:
            assert "still runs in its folder" in (sweep.jobs[1].progress.note or "")
            holder.kill()
            holder.wait()

    sweep.run(later)
    assert clock_s[0] >= 50.0


def test_a_job_starts_once_its_folder_is_free(
    holder: subprocess.Popen[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock_s = [0.0]
    monkeypatch.setattr(held_jobs, "running_s", lambda: clock_s[0])
    sweep = Sweep(tmp_path, jobs(2))

    free_later(sweep, holder, clock_s)
    assert sweep.states() == ["completed"] * 2
    assert sweep.jobs[1].progress.note is None


def test_a_job_of_a_sampler_waits_for_its_folder_too(
    holder: subprocess.Popen[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock_s, drawn = [0.0], jobs(2)
    monkeypatch.setattr(held_jobs, "running_s", lambda: clock_s[0])
    sweep = Sweep(tmp_path, drawn[:1])

    class Drawn(Study[Job]):
        def next(self) -> Job | None:
            return drawn.pop() if len(drawn) == 2 else None

    monkeypatch.setattr("test_sweep_nodes.Study", Drawn)

    free_later(sweep, holder, clock_s)
    assert sweep.states() == ["completed"] * 2


class OddFileOfOne(TrainingKind):
    """Jobs share a program, and one of them has a file that cannot be opened."""

    def together(self, job: Job, queue: Sequence[Job], alone: Collection[int]) -> tuple[Job, ...]:
        return (job,) if job.number in alone else tuple(queue)

    def start(self, jobs: tuple[Job, ...], slot: Slot) -> JobStart:
        if any(job.number == 1 for job in jobs):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "some/file")
        return super().start(jobs[:1], slot)


def test_of_jobs_of_one_program_that_cannot_start_only_the_odd_one_fails(tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, jobs(3))
    sweep.run(sweep.end_all, kind=OddFileOfOne)
    assert sweep.states() == ["completed", "failed", "completed"]


def ended_job() -> list[Job]:
    (job,) = jobs_of([compose()])
    job.progress.take({"env_steps": 9, "return": 1.0}, SweepConfig(objective="return"))
    return [job]


def test_room_is_kept_for_the_end_of_a_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = SweepPaths(tmp_path)
    files = JobsReport(ended_job(), SweepConfig(), dict, paths, OpenFolder(paths.root, "x"), 0.0)
    files.begin()
    assert read_json(paths.sweep)["status"] == "running"
    assert paths.reserve.stat().st_blocks * 512 >= 2 * paths.sweep.stat().st_size

    def while_there_is_room(write: Callable[..., None]) -> Callable[..., None]:
        return lambda *args: full() if paths.reserve.exists() else write(*args)

    for name in ("write_json", "write_text"):
        monkeypatch.setattr(report, name, while_there_is_room(getattr(report, name)))
    monkeypatch.setattr(report, "write_bytes", full)
    files._states.clear()
    files.update()  # Ends nothing.
    assert read_json(paths.sweep)["status"] == "running"
    before = paths.curves.read_bytes()
    assert files.end("failed") == "the report cannot be written (No space left on device)"
    assert read_json(paths.sweep)["status"] == "failed"
    assert paths.table.exists()
    assert paths.curves.read_bytes() == before  # The old picture is whole.
    assert not paths.reserve.exists()


def run(*overrides: str) -> int:
    return sweep_command(["env=ant", "seed=0,1", *overrides])


TPE = ("sweep.sampler=tpe", "sweep.trials=3")


@pytest.mark.parametrize("given", [(), ("run.dir=mine",), ("run.dir=there",)])
def test_a_refused_sweep_leaves_nothing(
    given: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "optuna", None)
    (tmp_path / "there").mkdir()
    assert run(*TPE, *given) == 2
    assert "pip install 'gmijax[sweep]'" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir() if path.name != "runs"] == ["there"]
    assert list((tmp_path / "there").iterdir()) == []
    assert not list(tmp_path.glob("runs/*"))


def test_a_disk_that_is_full_at_the_start_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gmijax.sweeps.runner.write_json", full)
    for sampler in ((), (*TPE, "algo.learning_rate=interval(1e-5,1e-3)")):
        assert run("run.dir=all", *sampler) == 1
        assert capsys.readouterr().err == "gmijax.sweep: some/file: No space left on device\n"
        assert not (tmp_path / "all").exists()


def test_the_folder_of_another_sweep_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    paths = SweepPaths(tmp_path / "all")
    paths.root.mkdir()
    with locked(paths.lock, "here"):  # One that has not written anything yet.
        assert run("run.dir=all") == 2
        assert paths.lock.exists()
    paths.request.write_text(json.dumps({"jobs": []}))
    assert run("run.dir=all") == 2
    assert "holds another sweep" in capsys.readouterr().err
    paths.request.write_text(json.dumps({"commands": [], "jobs": []}))
    assert run("run.dir=all") == 2
    assert "holds a pack; give another folder" in capsys.readouterr().err
    assert paths.request.exists()
