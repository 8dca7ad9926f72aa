"""One GMI's process as the controller sees it: start, heartbeat, signals, end."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

from gmijax.errors import GmiFailed, ReportedError
from gmijax.machine.processes import GuardPipe, members_of, wait_until_gone
from gmijax.runs.folder import GmiPaths, RunPaths
from gmijax.supervise.child import (
    END_BYTE,
    ENV_HEARTBEAT_FD,
    ENV_LIFELINE_FD,
    ENV_RUN_DIR,
    ENV_WAITS,
    GO_BYTE,
    LEFT_TO_CONTROLLER,
    STACKS_SIGNAL,
    STOP_BYTE,
)
from gmijax.supervise.heartbeat import Heartbeat, HeartbeatBlock

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

    It inherits its lifeline, its heartbeat and `inherited_fds`, nothing else. With `waits` it
    compiles nothing before `let_go`.

    Raises:
      GmiFailed: the program cannot be started.

    Attributes:
      gmi: its id.
      waits: whether it may not compile yet.
      exit_code: None while it runs; negative for the signal that ended it.
      beat: the newest heartbeat that `poll` saw.
      paths: files of this GMI.
      progress_s: when it was started, let go, or its heartbeat last seen to be a new one;
        `time.monotonic`.
    """

    def __init__(
        self,
        gmi: int,
        command: Sequence[str],
        environment: Mapping[str, str],
        run: RunPaths,
        inherited_fds: Mapping[str, int],
        *,
        waits: bool = False,
    ) -> None:
        self.gmi = gmi
        self.waits = waits
        self.exit_code: int | None = None
        self.paths = run.gmi(gmi)
        self.paths.root.mkdir(parents=True, exist_ok=True)
        for stale in (self.paths.error, self.paths.result):
            stale.unlink(missing_ok=True)
        self._lifeline, heartbeat_fd = GuardPipe(), HeartbeatBlock.create()
        own = {ENV_LIFELINE_FD: self._lifeline.read_end, ENV_HEARTBEAT_FD: heartbeat_fd}
        inherited = {**own, **inherited_fds}
        variables = {name: str(fd) for name, fd in inherited.items()}
        if waits:
            variables[ENV_WAITS] = "1"
        variables = {**environment, **variables, ENV_RUN_DIR: str(run.root)}
        try:
            self._block = HeartbeatBlock(heartbeat_fd)
            self._process = _spawn(command, variables, self.paths, tuple(inherited.values()))
        except OSError as error:
            self._lifeline.close()
            raise GmiFailed(gmi, f"cannot start {command[0]}: {error.strerror}") from error
        except BaseException:
            self._lifeline.close()
            raise
        finally:
            os.close(self._lifeline.read_end)
            os.close(heartbeat_fd)
        self.progress_s = time.monotonic()
        self.beat = Heartbeat("starting", 0, self.pid)
        self._num_beats = 0
        self._was_ready = False

    @property
    def pid(self) -> int:
        """The process that was started, leader of its group."""
        return self._process.pid

    @property
    def is_ready(self) -> bool:
        """Whether the GMI has once been ready, or has ended well without saying so."""
        return self._was_ready or self.exit_code == 0

    @property
    def error(self) -> ReportedError | None:
        """The exception that it said it ends with, None without one."""
        return self._block.read_error()

    def status(self) -> GmiStatus:
        """A snapshot for progress displays."""
        beat = self.beat
        state = "waiting" if self.waits else beat.state
        return GmiStatus(self.gmi, state, beat.iteration, beat.pid, self.exit_code)

    def poll(self) -> int | None:
        """Reads the heartbeat and the exit code; ends what is left of an ended GMI's group."""
        self._refresh()
        if self.exit_code is None and self._has_ended():
            # Before the zombie is reaped its group's number cannot go to somebody else.
            others = members_of(self.pid)
            self.kill()
            wait_until_gone(others, _GROUP_ENDS_S)
            self.exit_code = self._process.wait()
            self._refresh()
        return self.exit_code

    def let_go(self) -> None:
        """Lets a GMI compile that was started to wait."""
        self.waits = False
        self.progress_s = time.monotonic()
        self._lifeline.write(GO_BYTE)

    def ask_to_stop(self) -> None:
        """Asks the GMI to finish its iteration, save and end."""
        self._lifeline.write(STOP_BYTE)

    def order_end(self) -> None:
        """Makes the GMI and all that it started end at once, without saving."""
        self._lifeline.write(END_BYTE)

    def request_stacks(self) -> int | None:
        """Has the GMI write the stacks of its threads to its log; the log's size before.

        None where it has not started far enough for that: the signal would end it.
        """
        if self.exit_code is not None or not self._num_beats:
            return None
        size = self.log_bytes
        with suppress(ProcessLookupError, PermissionError):
            os.kill(self.beat.pid, STACKS_SIGNAL)
        return size

    @property
    def log_bytes(self) -> int:
        """Size of what it has written to stderr."""
        try:
            return self.paths.stderr.stat().st_size
        except OSError:
            return 0

    def end_as_done(self) -> None:
        """Ends a GMI that has said that it is done, but whose process stays."""
        self.kill()
        self._process.wait()
        self.exit_code = 0

    def kill(self) -> None:
        """Kills the GMI and everything it started; nothing once it is reaped."""
        if self.exit_code is None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)

    def close(self) -> None:
        """Drops the lifeline: a process that is still there ends itself."""
        self._lifeline.close()

    def _has_ended(self) -> bool:
        flags = os.WEXITED | os.WNOHANG | os.WNOWAIT
        try:
            return os.waitid(os.P_PID, self.pid, flags) is not None
        except ChildProcessError:
            return True

    def _refresh(self) -> None:
        beats = self._block.beats
        # A beat with equal content counts as progress too.
        if beats != self._num_beats and (beat := self._block.read()):
            self.beat, self._num_beats = beat, beats
            self._was_ready |= beat.is_ready
            self.progress_s = time.monotonic()


def _spawn(
    command: Sequence[str], environment: Mapping[str, str], paths: GmiPaths, fds: tuple[int, ...]
) -> subprocess.Popen[bytes]:
    # The child inherits that they are blocked, until it can leave them to this process.
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, LEFT_TO_CONTROLLER)
    try:
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
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
