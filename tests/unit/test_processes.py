"""Processes by number and start time."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from gmijax.machine.interpreter import command
from gmijax.machine.processes import (
    ProcessId,
    identify,
    members_of,
    own_process,
    started_by,
    that_have_open,
    wait_until_gone,
)
from gmijax.supervise.stop_signals import STOP_SIGNALS


def test_zombie_is_not_running():
    child = subprocess.Popen(["sleep", "0"])
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert identify(child.pid) is None
    child.wait()


def test_reused_number_is_another_process():
    own = own_process()
    assert own == identify(os.getpid())
    assert own.is_running()
    assert not own._replace(start_ticks=own.start_ticks + 1).is_running()
    assert not ProcessId(0, 0).is_running()


def test_name_of_a_program_may_hold_brackets_and_bytes_that_are_no_text(tmp_path: Path):
    program = tmp_path / os.fsdecode(b"a) Z 1 \xff")
    shutil.copy("/bin/sleep", program)
    child = subprocess.Popen([program, "60"])
    try:
        process = identify(child.pid)
        assert process is not None
        assert process.is_running()
    finally:
        child.kill()
        child.wait()
    assert not process.is_running()


def test_waiting_ends_in_time_and_returns_what_still_runs():
    own = own_process()
    assert wait_until_gone([own], timeout_s=0.05) == (own,)
    assert wait_until_gone([ProcessId(0, 0)], timeout_s=10) == ()


def test_members_of_a_group_are_those_that_run():
    shell = subprocess.Popen(
        ["sh", "-c", "sleep 60 & echo; exec sleep 60"],
        start_new_session=True,
        stdout=subprocess.PIPE,
    )
    try:
        assert shell.stdout is not None
        shell.stdout.readline()
        assert len(members_of(shell.pid)) == 2
        assert identify(shell.pid) in members_of(shell.pid)
    finally:
        os.killpg(shell.pid, signal.SIGKILL)
        shell.communicate()
    assert wait_until_gone(members_of(shell.pid), timeout_s=10) == ()


def test_what_a_group_has_started_is_found_in_groups_of_its_own():
    inner = "import os, sys, time; os.setsid(); print(os.getpid(), flush=True); time.sleep(60)"
    outer = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {inner!r}])"
    process = subprocess.Popen(
        [sys.executable, "-c", outer], start_new_session=True, stdout=subprocess.PIPE
    )
    try:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        assert [one.pid for one in members_of(process.pid)] == [process.pid]
        assert {one.pid for one in started_by(process.pid)} == {process.pid, child}
    finally:
        for one in started_by(process.pid):
            os.kill(one.pid, signal.SIGKILL)
        process.communicate()
    assert started_by(process.pid) == ()


def test_a_janitor_ignores_what_asks_a_job_to_stop():
    """Batch systems send that to all processes of a job."""
    janitor = subprocess.Popen(command("gmijax.supervise.janitor"), stdin=subprocess.PIPE)
    try:
        status, mask = Path(f"/proc/{janitor.pid}/status"), 0
        wanted = sum(1 << (number - 1) for number in STOP_SIGNALS)
        deadline_s = time.monotonic() + 20.0
        while mask & wanted != wanted and time.monotonic() < deadline_s:
            time.sleep(0.02)
            mask = int(re.findall(r"SigIgn:\s*(\w+)", status.read_text())[0], 16)
        assert mask & wanted == wanted
    finally:
        janitor.communicate()
    assert janitor.returncode == 0


def test_who_has_a_file_open(tmp_path: Path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    for name in ("lock", "other"):
        (tmp_path / "real" / name).touch()
    assert that_have_open(tmp_path / "link" / "lock") == {}
    assert that_have_open(tmp_path / "nowhere") == {}
    with (tmp_path / "real" / "lock").open("rb") as file:
        child = subprocess.Popen(["sleep", "60"], stdin=file)
    try:
        assert that_have_open(tmp_path / "link" / "lock") == {child.pid: "sleep"}
        assert that_have_open(tmp_path / "real" / "other") == {}
    finally:
        child.kill()
        child.wait()
