"""The GMI's own side: heartbeats, errors, lifeline, and how failures are described."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from gmijax.errors import CollectiveTimeout, ConfigError, ReportedError
from gmijax.runs.folder import GmiPaths, RunPaths, read_json
from gmijax.supervise.child import ChildLink
from gmijax.supervise.failures import describe_exit, first_cause, is_consequence, last_line
from gmijax.supervise.heartbeat import Heartbeat, HeartbeatBlock

pytestmark = pytest.mark.timeout(20)


def test_link_is_read_from_the_environment(tmp_path: Path):
    with (tmp_path / "exchange").open("wb") as exchange:
        fd = exchange.fileno()
        os.set_inheritable(fd, True)
        link = ChildLink.from_environment(
            {"GMIJAX_GMI": "2", "GMIJAX_RUN_DIR": str(tmp_path), "GMIJAX_EXCHANGE_FD": str(fd)}
        )
        assert not os.get_inheritable(fd)
    assert (link.gmi, link.exchange_fd, link.stop_requested) == (2, fd, False)
    assert link.paths.root == tmp_path / "gmi_2"


@pytest.mark.parametrize("shown", ["", "seven", "-1", "999999", "99999999999999999999"])
def test_bad_descriptor_in_the_environment_is_named(tmp_path: Path, shown: str):
    variables = {"GMIJAX_GMI": "2", "GMIJAX_RUN_DIR": str(tmp_path), "GMIJAX_EXCHANGE_FD": shown}
    with pytest.raises(ConfigError, match=f"GMIJAX_EXCHANGE_FD='{shown}'"):
        ChildLink.from_environment(variables)


def test_a_process_that_is_no_gmi_gets_an_error():
    with pytest.raises(ConfigError, match="GMIJAX_GMI and GMIJAX_RUN_DIR must be set"):
        ChildLink.from_environment({})


@pytest.fixture
def block() -> Iterator[tuple[int, HeartbeatBlock]]:
    fd = HeartbeatBlock.create()
    yield fd, HeartbeatBlock(fd)
    os.close(fd)


def test_garbage_is_kept_until_a_gmi_is_ready(tmp_path: Path):
    link = ChildLink(0, RunPaths(tmp_path), None, None)
    seen = []
    try:
        link.keep_garbage()
        for state in ("starting", "waiting", "compiling", "ready"):
            link.beat(state, 0)
            seen.append(gc.isenabled())
        gc.disable()  # By a role of the user's own, say: that is theirs.
        link.beat("running", 1)
        seen.append(gc.isenabled())
    finally:
        gc.enable()
        gc.unfreeze()
    assert seen == [False, False, False, True, False]


def test_beats_and_errors_reach_whoever_has_the_memory(
    tmp_path: Path, block: tuple[int, HeartbeatBlock]
):
    fd, seen = block
    link = ChildLink(3, RunPaths(tmp_path), None, None, heartbeat_fd=fd)
    assert (seen.read(), seen.read_error(), seen.beats) == (None, None, 0)
    for iteration in range(50):
        link.beat("running", iteration)
    assert (seen.read(), seen.beats) == (Heartbeat("running", 49, os.getpid()), 50)
    try:
        raise ValueError("first\nsecond")
    except ValueError as error:
        link.report_error(error)
    assert "raise ValueError" in read_json(link.paths.error)["traceback"]
    failure = describe_exit(3, 1, seen.read_error(), link.paths.stderr, iteration=7)
    assert failure.reason == "exit code 1: ValueError: first; second"
    assert (failure.iteration, failure.error) == (7, seen.read_error())
    link.report_error(KeyboardInterrupt())
    described = describe_exit(3, 1, seen.read_error(), link.paths.stderr)
    assert described.reason == "exit code 1: KeyboardInterrupt"


def test_an_error_is_reported_where_nothing_can_be_written(
    tmp_path: Path, block: tuple[int, HeartbeatBlock]
):
    (tmp_path / "gmi_3").write_text("a file where the folder should be")
    link = ChildLink(3, RunPaths(tmp_path), None, None, heartbeat_fd=block[0])
    link.report_error(OSError(28, "No space left on device"))
    error = block[1].read_error()
    assert error is not None
    assert error.message == "[Errno 28] No space left on device"


def test_an_error_of_any_length_fits(block: tuple[int, HeartbeatBlock]):
    text = "\x00\N{GRINNING FACE}\udcff" * 10_000
    block[1].write_error(ReportedError("E", text, text, tuple(range(10_000, 20_000))))
    error = block[1].read_error()
    assert error is not None
    assert len(error.message) == 2000
    assert error.missing == tuple(range(10_000, 10_200))
    lines = ["Traceback (most recent call last):", *["  File x"] * 1_000, "ZeroDivisionError: y"]
    block[1].write_error(ReportedError("E", "\n".join(lines), ""))
    error = block[1].read_error()
    assert error is not None
    assert error.message == f"{lines[0]} {lines[-1]}"


_STACKS = """Fatal Python error: Aborted

Current thread 0x00007f8a5b7fe640 (most recent call first):
  File "/lib/threading.py", line 629 in wait
  ...

Thread 0x00007f608c7d2b80 (most recent call first):
  <no Python frame>

Extension modules: uvloop.loop, yaml._yaml (total: 2)
"""
"""What `faulthandler` writes."""


@pytest.mark.parametrize(
    ("exit_code", "stderr", "reason"),
    [
        (3, "a\nb\n\n", "exit code 3: b"),
        (3, "", "exit code 3"),
        (-11, "", "ended by SIGSEGV"),
        (-9, "", "ended by SIGKILL: not killed by gmijax; perhaps the machine ran out of memory"),
        (-99, "", "ended by signal 99"),
        (-6, "F0 Check failed: x\n" + _STACKS, "ended by SIGABRT: F0 Check failed: x"),
        (-11, _STACKS, "ended by SIGSEGV: Fatal Python error: Aborted"),
        (1, _STACKS + "RuntimeError: a worker died\n", "exit code 1: RuntimeError: a worker died"),
    ],
)
def test_end_without_an_error_file_is_described(
    tmp_path: Path, exit_code: int, stderr: str, reason: str
):
    paths = GmiPaths(tmp_path)
    paths.stderr.write_text(stderr)
    assert describe_exit(0, exit_code, None, paths.stderr).reason == reason


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("", "ValueError"),
        ("\n first \n second\n third", "ValueError: first"),
        ("what is wrong\n\nwhere\n", "ValueError: what is wrong; where"),
        (
            "calling back: Traceback (most recent call last):\n  File x\nZeroDivisionError: y",
            "ValueError: calling back: Traceback (most recent call last): ZeroDivisionError: y",
        ),
    ],
)
def test_an_error_of_several_lines_is_told_in_one(tmp_path: Path, message: str, shown: str):
    error = ReportedError("ValueError", message, "")
    assert describe_exit(0, 1, error, tmp_path / "log").reason == f"exit code 1: {shown}"


def test_cause_goes_before_consequence_and_an_abort_after_other_causes(tmp_path: Path):
    log = tmp_path / "stderr.log"
    late = CollectiveTimeout(gmi=0, missing=(1,), operation="mean", step=3, timeout_s=5)
    victim = describe_exit(0, 1, ReportedError(type(late).__name__, str(late), ""), log)
    bad_input = describe_exit(2, 1, ReportedError("ConfigError", "num_envs=7: too odd", ""), log)
    aborted = describe_exit(1, -signal.SIGABRT, None, log)
    killed = describe_exit(3, -signal.SIGKILL, None, log)
    for failures in ([victim], [victim, aborted], [victim, aborted, bad_input]):
        assert first_cause(failures) == failures[-1]
        assert first_cause([*failures, killed]) == killed
    assert is_consequence(victim)
    assert not is_consequence(aborted)


def test_of_those_that_waited_in_vain_the_first_one_is_shown(tmp_path: Path):
    """GMI 0 waited for GMI 2, which waited for GMI 1, which hangs and has not ended."""
    victims = [
        describe_exit(gmi, 1, ReportedError("CollectiveTimeout", "late", "", (missing,)), tmp_path)
        for gmi, missing in ((0, 2), (2, 1))
    ]
    for failures in (victims, victims[::-1]):
        assert first_cause(failures) is victims[1]


def test_only_the_end_of_a_long_log_is_read(tmp_path: Path):
    log = tmp_path / "stderr.log"
    log.write_text("x" * 100_000 + "\nthe end\n")
    assert last_line(log) == "the end"
    log.write_text("y" * 100_000)
    assert last_line(log) == "y" * 300
    assert last_line(tmp_path / "none") == ""


def test_a_lack_of_memory_is_named_where_xla_hides_it(tmp_path: Path):
    message = "NOT_FOUND: All configs failed during profiling or were excluded from selection."
    error = ReportedError("JaxRuntimeError", message, message, ())
    reason = describe_exit(0, 1, error, GmiPaths(tmp_path).stderr).reason
    assert reason.startswith(
        f"exit code 1: JaxRuntimeError: {message} (perhaps there is too little"
    )
