"""No time limit goes on while the process that watches it is stopped."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from supervision import CHECKOUT, cpu_supervisor, machine, make_launch, planned

from gmijax import clock
from gmijax.autotune import profile
from gmijax.cluster.remote_gmi import RemoteNode
from gmijax.collectives.host.barrier import Barrier
from gmijax.collectives.host.shared_block import attach, create_exchange
from gmijax.collectives.waits import wait_until
from gmijax.errors import CollectiveTimeout, GmiFailed, JobInterrupted, ReportedError
from gmijax.machine.processes import has_ended, identify, wait_until_gone
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends import open_backend
from gmijax.supervise.heartbeat import Heartbeat
from gmijax.supervise.stop_signals import StopSignals
from gmijax.supervise.supervisor import Supervisor
from gmijax.supervise.watched_gmi import WatchedGmi
from gmijax.sweeps import children
from gmijax.sweeps.curve_window import CurveWindow

A_WHILE_S = 10_000.0
LIMIT_S = 5.0
"""Of what is suspended for a while; more than a test takes."""

Stop = Callable[[], None]


@pytest.fixture
def stop(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stop]:
    """Stops this process for a while, as far as any clock shows."""
    real, stopped = time.monotonic, [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: real() + stopped[0])
    clock.running_s()
    before = dict(vars(clock.running_s))

    def stop() -> None:
        stopped[0] += A_WHILE_S

    yield stop
    vars(clock.running_s).update(before)


def after_looks(stop: Stop) -> Callable[[], bool | None]:
    """Asks whether something is so: at the third look the process stops, at the sixth it is."""
    looks = 0

    def is_so() -> bool | None:
        nonlocal looks
        looks += 1
        if looks == 3:
            stop()
        return True if looks >= 6 else None

    return is_so


def test_of_a_gap_between_two_looks_a_second_counts(stop: Stop) -> None:
    before_s = clock.running_s()
    for times in (1, 2):
        stop()
        assert clock.running_s() - before_s == pytest.approx(times, abs=0.5)


def test_two_threads_leave_a_gap_out_once(stop: Stop) -> None:
    before_s = clock.running_s()
    stop()
    found: list[float] = []
    threads = [threading.Thread(target=lambda: found.append(clock.running_s())) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(seen_s - before_s == pytest.approx(1.0, abs=0.9) for seen_s in found)


def test_a_time_limit_still_ends_a_wait() -> None:
    assert wait_until(lambda: None, lambda: None, 0.05) is None
    assert not clock.wait_for(threading.Event().wait, 0.05)


def test_a_wait_for_another_process_goes_on(stop: Stop) -> None:
    assert wait_until(after_looks(stop), lambda: None, LIMIT_S)
    is_so = after_looks(stop)
    assert clock.wait_for(lambda _: bool(is_so()), LIMIT_S)


def barriers(limit_s: float) -> list[Barrier]:
    """Of two ranks."""
    fd = create_exchange()
    made = [Barrier(attach(fd, rank, 2, 10, 0), limit_s, limit_s) for rank in range(2)]
    os.close(fd)
    return made


def test_a_barrier_goes_on(stop: Stop) -> None:
    first, second = barriers(LIMIT_S)
    looks = 0

    def wait(_: float) -> bool:
        nonlocal looks
        looks += 1
        if looks == 2:
            stop()
        return looks > 4

    # Its device is at a step, the peer is silent.
    first.watch(SimpleNamespace(wait=wait))
    second.leave()
    first, second = barriers(0.0)
    with pytest.raises(CollectiveTimeout):
        first.watch(SimpleNamespace(wait=lambda s: bool(time.sleep(s))))
    second.leave()


class ScriptedGmi(WatchedGmi):
    """A GMI of a supervisor, without a process, which ends well at its tenth poll."""

    error: ReportedError | None = None
    is_ended = False

    def __init__(self, gmi: int, run: RunPaths, state: Any) -> None:
        super().__init__(gmi, run.gmi(gmi), os.getpid())
        self._state, self._polls = state, 0

    def poll(self) -> int | None:
        self._polls += 1
        if self._polls == 1:
            self._record_heartbeat(1, Heartbeat(self._state, 1, self.pid))
        if self._polls >= 10 and self.exit_code is None:
            self.exit_code = 0
        return self.exit_code

    def end_as_done(self) -> None:
        self.is_ended, self.exit_code = True, 0

    @property
    def log_bytes(self) -> int:
        return 0

    def request_stacks(self) -> int | None:
        return None

    def kill(self) -> None:
        self.exit_code = -9

    def ask_to_stop(self) -> None: ...
    def order_end(self) -> None: ...
    def close(self) -> None: ...


def supervised(
    tmp_path: Path, state: Any, signals: StopSignals | None = None
) -> tuple[Supervisor, ScriptedGmi]:
    run, here = RunPaths(tmp_path), machine(0)
    plan = planned(here, gmis_per_gpu=1)
    limits = dict.fromkeys(("start", "stall", "stop", "grace"), LIMIT_S)
    launch = make_launch(run, ["train"], plan, **limits)
    gmi = ScriptedGmi(0, run, state)
    backend = open_backend(plan, here, run)
    return Supervisor(launch, backend, start=lambda _: gmi, signals=signals), gmi


@pytest.mark.parametrize("state", ["starting", "compiling", "running", "done"])
def test_a_gmi_has_not_stalled_meanwhile(tmp_path: Path, stop: Stop, state: Any) -> None:
    supervisor, gmi = supervised(tmp_path, state)
    is_so = after_looks(stop)
    supervisor.run(lambda _: bool(is_so()))
    assert not gmi.is_ended


def test_no_time_limit_runs_while_another_process_compiles(tmp_path: Path) -> None:
    supervisor, gmi = supervised(tmp_path, "waiting")
    gmi.progress_s -= 100 * LIMIT_S
    supervisor.run()
    assert gmi.exit_code == 0


def test_a_gmi_that_is_to_stop_is_not_late(tmp_path: Path, stop: Stop) -> None:
    signals = StopSignals()
    supervisor, _ = supervised(tmp_path, "running", signals)
    is_so = after_looks(stop)

    def tick(_: Any) -> None:
        if not signals.have_come:
            signals.handle(signal.SIGTERM)
        is_so()

    with pytest.raises(JobInterrupted, match=r"^stopped$"):
        supervisor.run(tick)


def test_a_gmi_that_hangs_is_still_found(tmp_path: Path, stop: Stop) -> None:
    supervisor = cpu_supervisor(RunPaths(tmp_path), ["stall"], stall=1.0)
    with pytest.raises(GmiFailed, match="made no progress after iteration 5 within 1 s"):
        supervisor.run(lambda _: None)


def test_a_node_is_not_lost_meanwhile(stop: Stop) -> None:
    answer = SimpleNamespace(is_there=lambda: False)
    node = RemoteNode(lambda *_: answer, 1, "10.0.0.2")
    node.look(0)
    stop()
    node.look(0)
    assert node.lost is None


def test_who_waits_for_the_end_of_processes_goes_on(stop: Stop) -> None:
    with subprocess.Popen(["sleep", "0.6"]) as process:
        seen = identify(process.pid)
        assert seen is not None
        timer = threading.Timer(0.2, stop)
        timer.start()
        assert has_ended(process, LIMIT_S)
    with subprocess.Popen(["sleep", "0.6"]) as process:
        seen = identify(process.pid)
        assert seen is not None
        timer = threading.Timer(0.2, stop)
        timer.start()
        assert not wait_until_gone([seen], LIMIT_S)


def test_a_profile_is_not_late(stop: Stop) -> None:
    watch = profile._until(LIMIT_S, lambda _: None)
    stop()
    watch(())


def test_jobs_of_a_sweep_are_not_late(
    stop: Stop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job: Any = SimpleNamespace(progress=SimpleNamespace(env_steps=0, state="running"))
    window = CurveWindow([job], LIMIT_S)
    stop()
    assert not window.is_over()
    child = children.Child(children.Process("job", ("true",), tmp_path / "log"), {})
    while child.look().exit_code is None:
        time.sleep(0.01)
    # Something that it has started is still there.
    monkeypatch.setattr(children, "members_of", lambda _: (1,))
    for _ in range(2):
        assert child.look().exit_code is None
        stop()
    child.close()


def test_no_time_limit_is_by_another_clock() -> None:
    compared = re.compile(r"deadline|limit_s|_timeout_s|[<>]")
    others = [
        f"{file.relative_to(CHECKOUT)}: {line.strip()}"
        for file in (CHECKOUT / "gmijax").rglob("*.py")
        for line in file.read_text().splitlines()
        if "monotonic()" in line and compared.search(line) and file.name != "clock.py"
    ]
    # How often something is done, and not when somebody is late.
    often = ("LINE_EVERY_S", "_next_look_s", "_SLICE_S")
    assert [line for line in others if not any(word in line for word in often)] == []
