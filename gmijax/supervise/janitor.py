"""Cleans up after a controller that was killed: `python -m gmijax.supervise.janitor`.

A killed controller runs no clean-up. GMIs end by themselves then, but one that hangs in a driver
cannot, and an MPS daemon outlives the process that started it. So a janitor is started before
them, in a session of its own, and reads from a pipe what there is to clean, one JSON object a line
(see `JanitorLink`). The pipe's end without the word `clean` means that the controller is gone.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

from gmijax.clock import running_s
from gmijax.errors import BackendUnavailable
from gmijax.machine.interpreter import command
from gmijax.machine.mps_control import MpsControl
from gmijax.machine.processes import (
    GuardPipe,
    ProcessId,
    has_ended,
    identify,
    members_of,
    wait_until_gone,
)
from gmijax.supervise.stop_signals import STOP_SIGNALS

_GMIS_END_THEMSELVES_S = 8.0
_DAEMON_ENDS_S = 10.0
_LATE_DAEMON_S = 2.0
_POLL_S = 0.1

_Groups: TypeAlias = Mapping[int, set[ProcessId]]
"""Process groups by number, with members that are known."""


class JanitorLink:
    """The controller's end of the pipe to a janitor.

    Args:
      log: where the janitor's own errors go; removed at the end if there are none.
    """

    def __init__(self, log: Path) -> None:
        log.parent.mkdir(parents=True, exist_ok=True)
        self._log = log
        self._pipe = GuardPipe()
        try:
            with log.open("wb") as errors:
                self._process = subprocess.Popen(
                    command("gmijax.supervise.janitor"),
                    stdin=self._pipe.read_end,
                    stdout=errors,
                    stderr=errors,
                    start_new_session=True,
                )
        except BaseException:
            self._pipe.close()
            raise
        finally:
            os.close(self._pipe.read_end)

    def watch_daemon(self, control: MpsControl) -> None:
        """Makes the janitor quit a daemon that is to start, and remove its pipe directory."""
        self._send({"daemon": str(control.pipe_directory), "program": str(control.program)})

    def watch_gmi(self, pid: int, group: int | None = None) -> None:
        """Makes the janitor wait for the process group of this process, and kill it if it stays.

        Args:
          pid: of the group's leader, or of another member.
          group: its number; None: that of the process.
        """
        if process := identify(pid):
            self._send({"gmi": list(process), "group": group or pid})

    def dismiss(self) -> None:
        """Reports that everything is clean and waits for the janitor to end."""
        self._send({"clean": True})
        self._pipe.close()
        if not has_ended(self._process, _DAEMON_ENDS_S):
            self._process.kill()
            self._process.wait()
        with suppress(OSError):
            if not self._log.stat().st_size:
                self._log.unlink()

    def take_over(self) -> None:
        """Lets the janitor clean up now, as if this process were gone, and waits for it."""
        self._pipe.close()
        self._process.wait()

    def _send(self, message: dict[str, Any]) -> None:
        # A janitor that was killed must not end the job that it only guards.
        self._pipe.write(json.dumps(message).encode() + b"\n")


def quit_daemon(control: MpsControl) -> None:
    """Ends a daemon that gmijax has started, and removes its pipe directory.

    A daemon or server that does not end when asked is killed: no other process knows of it.
    """
    daemon = control.daemon_pid()
    pids = {daemon} if daemon is not None else set()
    with suppress(BackendUnavailable):
        pids |= set(control.server_pids())
    processes = [process for pid in pids if (process := identify(pid))]
    with suppress(BackendUnavailable):
        control.quit(_DAEMON_ENDS_S)
    for process in wait_until_gone(processes, _DAEMON_ENDS_S):
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGKILL)
    shutil.rmtree(control.pipe_directory, ignore_errors=True)


def main() -> int:
    """Reads messages until the pipe ends, then cleans up unless the controller has."""
    for number in STOP_SIGNALS:  # All processes of a job may get them.
        signal.signal(number, signal.SIG_IGN)
    groups: defaultdict[int, set[ProcessId]] = defaultdict(set)
    daemons: list[MpsControl] = []
    for line in sys.stdin:
        message: dict[str, Any] = json.loads(line)
        if "clean" in message:
            return 0
        if "daemon" in message:
            daemons.append(MpsControl(Path(message["program"]), Path(message["daemon"])))
        else:
            groups[message["group"]].add(ProcessId(*message["gmi"]))
    # The GMIs notice by themselves that the controller is gone.
    if left := _wait_until_empty(groups, _GMIS_END_THEMSELVES_S):
        _kill(left, daemons)
    for control in daemons:
        # The controller may have been killed while it was starting this one.
        deadline_s = running_s() + _LATE_DAEMON_S
        while not control.is_answering() and running_s() < deadline_s:
            time.sleep(_LATE_DAEMON_S / 10)
        quit_daemon(control)
    return 0


def _kill(groups: _Groups, daemons: Iterable[MpsControl]) -> None:
    """Ends GMIs that did not end by themselves, first on the GPU."""
    for control in daemons:
        # All clients of an own daemon are GMIs of the job.
        with suppress(BackendUnavailable):
            for client, server in control.all_client_pids().items():
                control.terminate_client(server, client)
    left = _with_members(groups)
    for group in left:
        with suppress(ProcessLookupError, PermissionError):  # `sudo` runs as another user.
            os.killpg(group, signal.SIGKILL)
    _wait_until_empty(left, _DAEMON_ENDS_S)


def _wait_until_empty(groups: _Groups, timeout_s: float) -> _Groups:
    """Waits until no group has a member; returns those that have after `timeout_s`."""
    deadline_s = running_s() + timeout_s
    left = _with_members(groups)
    while left and running_s() < deadline_s:
        time.sleep(_POLL_S)
        left = _with_members(left)
    return left


def _with_members(groups: _Groups) -> _Groups:
    """The groups in which a known member runs, with all that run in them now.

    A group keeps its number while it has a member, also without its leader; an empty one may lose
    it to another one.
    """
    left: dict[int, set[ProcessId]] = {}
    for group, known in groups.items():
        running = {process for process in known if process.is_running()}
        members = set(members_of(group)) if running else set()
        # Where a leader has run, the number was its group's, even if it has ended since.
        if members & known or (members and any(one.pid == group for one in running)):
            left[group] = members
    return left


if __name__ == "__main__":
    sys.exit(main())
