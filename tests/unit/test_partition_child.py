"""The GMI's own side: heartbeats, errors, lifeline, and how failures are described."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gmijax.errors import CollectiveTimeout, ConfigError, GmiFailed, ReportedError
from gmijax.runs.folder import GmiPaths, RunPaths, read_json
from gmijax.supervise.child import ChildLink
from gmijax.supervise.failures import describe_exit, first_cause, last_line
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


def test_process_that_is_no_gmi_is_told():
    with pytest.raises(ConfigError, match="GMIJAX_GMI and GMIJAX_RUN_DIR must be set"):
        ChildLink.from_environment({})


@pytest.fixture
def block() -> Iterator[tuple[int, HeartbeatBlock]]:
    fd = HeartbeatBlock.create()
    yield fd, HeartbeatBlock(fd)
    os.close(fd)


def test_beats_and_errors_reach_whoever_has_the_memory(
    tmp_path: Path, block: tuple[int, HeartbeatBlock]
):
    fd, seen = block
    link = ChildLink(3, RunPaths(tmp_path), None, None, heartbeat_fd=fd)
    assert (seen.read(), seen.read_error(), seen.beats) == (None, None, 0)
    for iteration in range(50):
        link.beat("running", iteration)
    assert (seen.read(), seen.beats) == (Heartbeat("running", 49, os.getpid()), 50)
    link.report_error(ValueError("the sum is off"))
    error = seen.read_error()
    assert error is not None
    assert (error.type, error.message) == ("ValueError", "the sum is off")


def test_an_error_of_any_length_fits(block: tuple[int, HeartbeatBlock]):
    text = "\x00\N{GRINNING FACE}\udcff" * 10_000
    block[1].write_error(ReportedError("E", text, text))
    error = block[1].read_error()
    assert error is not None
    assert len(error.message) == 2000


def test_an_error_is_told_where_nothing_can_be_written(
    tmp_path: Path, block: tuple[int, HeartbeatBlock]
):
    (tmp_path / "gmi_3").write_text("a file where the folder should be")
    link = ChildLink(3, RunPaths(tmp_path), None, None, heartbeat_fd=block[0])
    link.report_error(OSError(28, "No space left on device"))
    failure = describe_exit(3, 1, block[1].read_error(), tmp_path / "stderr.log")
    assert failure.reason == "exit code 1: OSError: [Errno 28] No space left on device"


def test_lifeline_asks_for_a_stop(tmp_path: Path):
    read_end, write_end = os.pipe()
    link = ChildLink(0, RunPaths(tmp_path), lifeline_fd=read_end, exchange_fd=None)
    os.write(write_end, b"s")
    while not link.stop_requested:
        time.sleep(0.01)
    # Both ends stay open: the end of the pipe would end this process.


def test_lifeline_ends_the_process_with_the_controller(tmp_path: Path):
    read_end, write_end = os.pipe()
    code = (
        "import sys; from pathlib import Path; from gmijax.runs.folder import RunPaths;"
        "from gmijax.supervise.child import ChildLink;"
        "ChildLink(0, RunPaths(Path('.')), int(sys.argv[1]), None)\nwhile True: pass"
    )
    child = subprocess.Popen([sys.executable, "-c", code, str(read_end)], pass_fds=(read_end,))
    os.close(read_end)
    assert child.poll() is None
    os.close(write_end)
    assert child.wait(10) == 1


def test_error_is_reported_and_described(tmp_path: Path, block: tuple[int, HeartbeatBlock]):
    link = ChildLink(3, RunPaths(tmp_path), None, None, heartbeat_fd=block[0])
    try:
        raise ValueError("first\nsecond")
    except ValueError as error:
        link.report_error(error)
    assert "raise ValueError" in read_json(link.paths.error)["traceback"]
    failure = describe_exit(3, 1, block[1].read_error(), link.paths.stderr, iteration=7)
    assert failure.reason == "exit code 1: ValueError: first"
    error = failure.to_error()
    assert isinstance(error, GmiFailed)
    assert (error.iteration, error.error) == (7, block[1].read_error())


@pytest.mark.parametrize(
    ("exit_code", "stderr", "reason"),
    [
        (3, "a\nb\n\n", "exit code 3: b"),
        (3, "", "exit code 3"),
        (-11, "", "ended by SIGSEGV"),
        (-9, "", "ended by SIGKILL: not killed by gmijax; perhaps the machine ran out of memory"),
        (-99, "", "ended by signal 99"),
    ],
)
def test_end_without_an_error_file_is_described(
    tmp_path: Path, exit_code: int, stderr: str, reason: str
):
    paths = GmiPaths(tmp_path)
    paths.stderr.write_text(stderr)
    assert describe_exit(0, exit_code, None, paths.stderr).reason == reason


def test_an_abort_comes_after_other_causes(tmp_path: Path):
    bad_input = ReportedError("ConfigError", "num_envs=7: too odd", "")
    log = tmp_path / "stderr.log"
    aborted = describe_exit(1, -signal.SIGABRT, None, log)
    assert first_cause([aborted, describe_exit(2, 1, bad_input, log)]).gmi == 2
    assert first_cause([aborted]).gmi == 1
    assert first_cause([aborted, describe_exit(0, -signal.SIGKILL, None, log)]).gmi == 0


def test_cause_goes_before_consequence(tmp_path: Path):
    error = CollectiveTimeout(rank=0, missing=(1,), operation="mean", step=3, timeout_s=5)
    log = tmp_path / "stderr.log"
    victim = describe_exit(0, 1, ReportedError(type(error).__name__, str(error), ""), log)
    failures = [victim, describe_exit(1, 3, None, log)]
    assert first_cause(failures).gmi == 1
    assert first_cause([*failures, describe_exit(2, -9, None, log)]).gmi == 2
    assert first_cause(failures[:1]).is_consequence
    assert first_cause(failures[:1]).is_timeout


def test_only_the_end_of_a_long_log_is_read(tmp_path: Path):
    log = tmp_path / "stderr.log"
    log.write_text("x" * 100_000 + "\nthe end\n")
    assert last_line(log) == "the end"
    log.write_text("y" * 100_000)
    assert last_line(log) == "y" * 300
    assert last_line(tmp_path / "none") == ""
