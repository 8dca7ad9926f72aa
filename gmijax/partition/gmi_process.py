"""One GMI's process as the controller sees it: start, heartbeat, signals, end."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

from gmijax.errors import GmiFailed
from gmijax.partition.child import ENV_LIFELINE_FD, ENV_RUN_DIR, ENV_WAITS, GO_BYTE, STOP_BYTE
from gmijax.partition.heartbeat import Heartbeat, read_heartbeat
from gmijax.processes import members_of, wait_until_gone
from gmijax.rundir import GmiPaths, RunPaths

_GROUP_ENDS_S = 2.0
"""A killed process is gone in milliseconds, unless a driver holds it."""


class GmiStatus(NamedTuple):
    """Where a GMI stands.

    Attributes:
      gmi: its id.
      state: `waiting` until it may compile, else what it says (see `heartbeat`).
      iteration: training iterations done.
      pid: its process, None before the start.
      exit_code: None while it runs; negative for the signal that ended it.
    """

    gmi: int
    state: str
    iteration: int
    pid: int | None
    exit_code: int | None


class GmiProcess:
    """A started GMI, the leader of its own session and process group.

    Attributes:
      gmi: its id.
      waits: whether it may not compile yet.
      exit_code: None while it runs; negative for the signal that ended it.
      progress_s: when it was started, let go, or its heartbeat last seen to be a new one;
        `time.monotonic`.
    """

    def __init__(
        self,
        gmi: int,
        process: subprocess.Popen[bytes],
        lifeline: int,
        paths: GmiPaths,
        *,
        waits: bool,
    ) -> None:
        self.gmi = gmi
        self.waits = waits
        self.exit_code: int | None = None
        self.progress_s = time.monotonic()
        self._process = process
        self._lifeline = lifeline
        self._paths = paths
        self._beat = Heartbeat("starting", 0, process.pid)
        self._beat_stamp: tuple[int, int] | None = None
        self._was_ready = False

    @classmethod
    def start(
        cls,
        gmi: int,
        command: Sequence[str],
        environment: Mapping[str, str],
        run: RunPaths,
        inherited_fds: Mapping[str, int],
        *,
        waits: bool = False,
    ) -> GmiProcess:
        """Starts a fresh interpreter that inherits its lifeline, `inherited_fds`, nothing else.

        With `waits` it compiles nothing before `let_go`.

        Raises:
          GmiFailed: the program cannot be started.
        """
        paths = run.gmi(gmi)
        paths.root.mkdir(parents=True, exist_ok=True)
        for stale in (paths.heartbeat, paths.error, paths.result):
            stale.unlink(missing_ok=True)
        read_end, write_end = os.pipe()
        inherited = {ENV_LIFELINE_FD: read_end, **inherited_fds}
        variables = {name: str(fd) for name, fd in inherited.items()}
        if waits:
            variables[ENV_WAITS] = "1"
        try:
            process = _spawn(
                command,
                {**environment, **variables, ENV_RUN_DIR: str(run.root)},
                paths,
                tuple(inherited.values()),
            )
        except BaseException as error:
            os.close(write_end)
            if isinstance(error, OSError):
                what = f"cannot start {command[0]}: {error.strerror}"
                raise GmiFailed(gmi, what) from error
            raise
        finally:
            os.close(read_end)
        return cls(gmi, process, write_end, paths, waits=waits)

    @property
    def pid(self) -> int:
        """The process that was started, leader of its group."""
        return self._process.pid

    @property
    def beat(self) -> Heartbeat:
        """The newest heartbeat that `poll` saw."""
        return self._beat

    @property
    def is_ready(self) -> bool:
        """Whether the GMI has once been ready, or has ended well without saying so."""
        return self._was_ready or self.exit_code == 0

    @property
    def paths(self) -> GmiPaths:
        """Files of this GMI."""
        return self._paths

    def status(self) -> GmiStatus:
        """A snapshot for progress displays."""
        beat = self._beat
        state = "waiting" if self.waits else beat.state
        return GmiStatus(self.gmi, state, beat.iteration, beat.pid, self.exit_code)

    def poll(self) -> int | None:
        """Reads the heartbeat and the exit code; ends what is left of an ended GMI's group."""
        self._refresh()
        if self.exit_code is None and self._has_ended():
            # Before the zombie is reaped its group's number cannot go to somebody else.
            others = members_of(self.pid)
            self.send(signal.SIGKILL)
            wait_until_gone(others, _GROUP_ENDS_S)
            self.exit_code = self._process.wait()
            self._refresh()
        return self.exit_code

    def let_go(self) -> None:
        """Lets a GMI compile that was started to wait."""
        self.waits = False
        self.progress_s = time.monotonic()
        self._tell(GO_BYTE)

    def ask_to_stop(self) -> None:
        """Asks the GMI to finish its iteration, save and end."""
        self._tell(STOP_BYTE)

    def send(self, number: signal.Signals) -> None:
        """Sends a signal to the GMI and to everything it started; nothing once it is reaped."""
        if self.exit_code is None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, number)

    def close(self) -> None:
        """Drops the lifeline: a process that is still there ends itself."""
        if self._lifeline >= 0:
            os.close(self._lifeline)
            self._lifeline = -1

    def _tell(self, byte: bytes) -> None:
        with suppress(OSError):  # It may have ended.
            os.write(self._lifeline, byte)

    def _has_ended(self) -> bool:
        flags = os.WEXITED | os.WNOHANG | os.WNOWAIT
        try:
            return os.waitid(os.P_PID, self.pid, flags) is not None
        except ChildProcessError:
            return True

    def _refresh(self) -> None:
        try:
            stat = self._paths.heartbeat.stat()
        except OSError:
            return
        # Every beat is a new file, so a beat with equal content counts as progress too.
        stamp = (stat.st_mtime_ns, stat.st_ino)
        if stamp != self._beat_stamp and (beat := read_heartbeat(self._paths.heartbeat)):
            self._beat, self._beat_stamp = beat, stamp
            self._was_ready |= beat.is_ready
            self.progress_s = time.monotonic()


def _spawn(
    command: Sequence[str], environment: Mapping[str, str], paths: GmiPaths, fds: tuple[int, ...]
) -> subprocess.Popen[bytes]:
    # Files, not pipes: a child that floods a pipe which nobody reads would block.
    with paths.stdout.open("wb") as stdout, paths.stderr.open("wb") as stderr:
        return subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,
            pass_fds=fds,
        )
