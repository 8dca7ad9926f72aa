"""One GMI's process as the controller sees it: start, heartbeat, signals, end."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress

from gmijax.errors import GmiFailed, ReportedError
from gmijax.machine.processes import GuardPipe, members_of, wait_until_gone
from gmijax.runs.folder import GmiPaths, RunPaths
from gmijax.supervise.child import (
    END_BYTE,
    ENV_HEARTBEAT_FD,
    ENV_LIFELINE_FD,
    ENV_RUN_DIR,
    STACKS_SIGNAL,
    STOP_BYTE,
)
from gmijax.supervise.heartbeat import HeartbeatBlock
from gmijax.supervise.stop_signals import STOP_SIGNALS
from gmijax.supervise.watched_gmi import WatchedGmi

_GROUP_ENDS_S = 2.0
"""A killed process is gone in milliseconds, unless a driver holds it."""


class GmiProcess(WatchedGmi):
    """A started GMI, the leader of its own session and process group.

    It inherits its lifeline, its heartbeat and `inherited_fds`, nothing else.

    Raises:
      GmiFailed: the program cannot be started.
    """

    def __init__(
        self,
        gmi: int,
        command: Sequence[str],
        environment: Mapping[str, str],
        run: RunPaths,
        inherited_fds: Mapping[str, int],
    ) -> None:
        paths = run.gmi(gmi)
        paths.root.mkdir(parents=True, exist_ok=True)
        for stale in (paths.error, paths.result):
            stale.unlink(missing_ok=True)
        self._lifeline, heartbeat_fd = GuardPipe(), HeartbeatBlock.create()
        own = {ENV_LIFELINE_FD: self._lifeline.read_end, ENV_HEARTBEAT_FD: heartbeat_fd}
        inherited = {**own, **inherited_fds}
        variables = {name: str(fd) for name, fd in inherited.items()}
        variables = {**environment, **variables, ENV_RUN_DIR: str(run.root)}
        try:
            self._block = HeartbeatBlock(heartbeat_fd)
            self._process = _spawn(command, variables, paths, tuple(inherited.values()))
        except OSError as error:
            self._lifeline.close()
            raise GmiFailed(gmi, f"cannot start {command[0]}: {error.strerror}") from error
        except BaseException:
            self._lifeline.close()
            raise
        finally:
            os.close(self._lifeline.read_end)
            os.close(heartbeat_fd)
        super().__init__(gmi, paths, self._process.pid)

    @property
    def error(self) -> ReportedError | None:
        """See `WatchedGmi`."""
        return self._block.read_error()

    def poll(self) -> int | None:
        """See `WatchedGmi`."""
        self._refresh()
        if self.exit_code is None and self._has_ended():
            # Before the zombie is reaped its group's number cannot be reused.
            others = members_of(self.pid)
            self.kill()
            wait_until_gone(others, _GROUP_ENDS_S)
            self.exit_code = self._process.wait()
            self._refresh()
        return self.exit_code

    def ask_to_stop(self) -> None:
        """See `WatchedGmi`."""
        self._lifeline.write(STOP_BYTE)

    def order_end(self) -> None:
        """See `WatchedGmi`."""
        self._lifeline.write(END_BYTE)

    def request_stacks(self) -> int | None:
        """See `WatchedGmi`."""
        if self.exit_code is not None or not self.beats:
            return None
        size = self.log_bytes
        with suppress(ProcessLookupError, PermissionError):
            os.kill(self.beat.pid, STACKS_SIGNAL)
        return size

    @property
    def log_bytes(self) -> int:
        """See `WatchedGmi`."""
        try:
            return self.paths.stderr.stat().st_size
        except OSError:
            return 0

    def end_as_done(self) -> None:
        """See `WatchedGmi`."""
        self.kill()
        self._process.wait()
        self.exit_code = 0

    def kill(self) -> None:
        """See `WatchedGmi`."""
        if self.exit_code is None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)

    def close(self) -> None:
        """See `WatchedGmi`."""
        self._lifeline.close()

    def _has_ended(self) -> bool:
        flags = os.WEXITED | os.WNOHANG | os.WNOWAIT
        try:
            return os.waitid(os.P_PID, self.pid, flags) is not None
        except ChildProcessError:
            return True

    def _refresh(self) -> None:
        self._record_heartbeat(self._block.beats, self._block.read())


def _spawn(
    command: Sequence[str], environment: Mapping[str, str], paths: GmiPaths, fds: tuple[int, ...]
) -> subprocess.Popen[bytes]:
    # The child inherits that they are blocked, until it can leave them to this process.
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        # Files, not pipes: a child that floods a pipe without a reader would block.
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
