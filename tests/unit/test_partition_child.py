"""The GMI's own side: heartbeats, errors, lifeline, and how failures are described."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gmijax.errors import CollectiveTimeout, ConfigError, GmiFailed
from gmijax.partition.child import ChildLink
from gmijax.partition.failures import describe_exit, first_cause, last_line
from gmijax.partition.heartbeat import Heartbeat, read_heartbeat
from gmijax.rundir import GmiPaths, RunPaths, read_json, write_json

pytestmark = pytest.mark.timeout(20)


@pytest.fixture
def link(tmp_path: Path) -> ChildLink:
    return ChildLink(3, RunPaths(tmp_path), lifeline_fd=None, exchange_fd=None)


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


def test_beats_of_an_unchanged_state_are_limited(link: ChildLink):
    for iteration in range(50):
        link.beat("running", iteration)
    assert read_heartbeat(link.paths.heartbeat) == Heartbeat("running", 0, os.getpid())
    link.beat("done", 50)
    assert read_heartbeat(link.paths.heartbeat) == Heartbeat("done", 50, os.getpid())


@pytest.mark.parametrize("text", ["", "{", '{"state": "running"}', "[]"])
def test_broken_heartbeat_is_no_heartbeat(tmp_path: Path, text: str):
    path = tmp_path / "heartbeat.json"
    assert read_heartbeat(path) is None
    path.write_text(text)
    assert read_heartbeat(path) is None


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
        "import sys; from pathlib import Path; from gmijax.rundir import RunPaths;"
        "from gmijax.partition.child import ChildLink;"
        "ChildLink(0, RunPaths(Path('.')), int(sys.argv[1]), None)\nwhile True: pass"
    )
    child = subprocess.Popen([sys.executable, "-c", code, str(read_end)], pass_fds=(read_end,))
    os.close(read_end)
    assert child.poll() is None
    os.close(write_end)
    assert child.wait(10) == 1


def test_error_is_reported_and_described(link: ChildLink):
    try:
        raise ValueError("first\nsecond")
    except ValueError as error:
        link.report_error(error)
    assert "raise ValueError" in read_json(link.paths.error)["traceback"]
    failure = describe_exit(3, 1, link.paths)
    assert failure.reason == "exit code 1: ValueError: first"
    assert isinstance(failure.to_error(), GmiFailed)


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
    assert describe_exit(0, exit_code, paths).reason == reason


def test_an_abort_comes_after_other_causes(tmp_path: Path):
    bad_input, aborted = (GmiPaths(tmp_path / name) for name in "ab")
    write_json(bad_input.error, {"type": "ConfigError", "message": "num_envs=7: too odd"})
    failures = [describe_exit(1, -signal.SIGABRT, aborted), describe_exit(2, 1, bad_input)]
    assert first_cause(failures).gmi == 2
    assert first_cause(failures[:1]).gmi == 1
    assert first_cause([failures[0], describe_exit(0, -signal.SIGKILL, aborted)]).gmi == 0


def test_cause_goes_before_consequence(tmp_path: Path):
    victim, culprit, killed = (GmiPaths(tmp_path / name) for name in "abc")
    error = CollectiveTimeout(rank=0, missing=(1,), operation="mean", step=3, timeout_s=5)
    write_json(victim.error, {"type": type(error).__name__, "message": str(error)})
    failures = [describe_exit(0, 1, victim), describe_exit(1, 3, culprit)]
    assert first_cause(failures).gmi == 1
    assert first_cause([*failures, describe_exit(2, -9, killed)]).gmi == 2
    assert first_cause(failures[:1]).is_consequence


def test_only_the_end_of_a_long_log_is_read(tmp_path: Path):
    log = tmp_path / "stderr.log"
    log.write_text("x" * 100_000 + "\nthe end\n")
    assert last_line(log) == "the end"
    log.write_text("y" * 100_000)
    assert last_line(log) == "y" * 300
    assert last_line(tmp_path / "none") == ""
