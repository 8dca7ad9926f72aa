"""Processes of jobs on their machine: controllers of training runs, or other commands."""

from __future__ import annotations

import errno
import math
import os
import signal
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from gmijax.clock import running_s
from gmijax.errors import GmijaxError, JobNotStarted
from gmijax.machine.processes import GuardPipe, ProcessId, has_ended, members_of
from gmijax.runs.folder import write_json
from gmijax.runs.held import try_lock
from gmijax.supervise.failures import last_line

INTERRUPT_BYTE: Final = b"i"
"""Sent through the lifeline of a controller instead of Ctrl-C."""

_OF_ALL_JOBS: Final = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EROFS),
    *(errno.EIO, errno.ESTALE, errno.ENOTCONN, errno.ETIMEDOUT),
    *(errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM),
)
"""Errors of a start that the next job would have too: no disk or one that is gone, no descriptors,
processes or memory."""

_STAY_S = 15.0
"""Longest wait for the rest of a process group whose leader has ended."""

_KILLED_S = 5.0
"""Longest wait for the end of a process that was killed: a driver may hold it."""


class ChildStatus(NamedTuple):
    """What is known of a child.

    Attributes:
      exit_code: None while it runs; negative for the signal that ended it.
      last_line: that it printed, once it has ended.
    """

    exit_code: int | None
    last_line: str = ""


class Process(NamedTuple):
    """What runs one job, or several together.

    Attributes:
      name: of the job, in messages.
      arguments: of the command.
      log: file for what it prints; continued if it exists.
      variables: environment variables beside those of this process, and those of its slot.
      cwd: its working folder; None: that of this process.
      input_file: path and JSON content, written before the start.
      has_lifeline: whether its last argument is to be the number of a pipe that ends with this
        process, and may bring an `INTERRUPT_BYTE` before.
      is_client: whether it, or what it starts, uses the GPU of its slot without knowing of slots.
      memory_fraction: part of the GPU's memory that it may have then; None: not limited.
      stop_signal: asks it to save and end.
      lock: a file that is locked while the process or one that it has started runs.
    """

    name: str
    arguments: tuple[str, ...]
    log: Path
    variables: Mapping[str, str] = {}
    cwd: str | None = None
    input_file: tuple[Path, Mapping[str, Any]] | None = None
    has_lifeline: bool = False
    is_client: bool = False
    memory_fraction: float | None = None
    stop_signal: int = signal.SIGTERM
    lock: Path | None = None


class Child:
    """The process of a job, or of several that are trained together.

    Args:
      process: what is run.
      variables: environment variables of its slot.

    Attributes:
      lock: see `Process`.
      rest: what still runs of its process group, once the leader has ended.
      left: what still ran of it when it was closed: a driver may hold it, and what is another
        user's, as with `sudo`, cannot be killed.

    Raises:
      JobNotStarted: it cannot be started.
      GmijaxError: no job can.
    """

    def __init__(self, process: Process, variables: Mapping[str, str]) -> None:
        self._log, self._stop_signal = process.log, process.stop_signal
        self._is_client, self._is_asked = process.is_client, False
        self._pipe = GuardPipe()
        self._ended_s: float | None = None
        self._killed_s = math.inf
        self.lock = process.lock
        self.rest: tuple[ProcessId, ...] = ()
        self.left: tuple[ProcessId, ...] = ()
        lifeline = (self._pipe.read_end,) if process.has_lifeline else ()
        try:
            with errors_of_one_job(process.cwd):
                self._process = _popen(process, variables, lifeline)
        except OSError as error:
            self._pipe.close()
            raise GmijaxError(f"{process.name}: cannot be started ({error.strerror})") from None
        except JobNotStarted:
            self._pipe.close()
            raise
        finally:
            os.close(self._pipe.read_end)

    @property
    def pid(self) -> int:
        """Its number; that of its process group too."""
        return self._process.pid

    def look(self) -> ChildStatus:
        """How it is; it has ended when its process group has, or is late with that."""
        code = self._process.poll()
        if code is None:
            return ChildStatus(None)
        self._ended_s = self._ended_s or running_s()
        is_late = running_s() - self._ended_s >= _STAY_S
        self.rest = members_of(self.pid)
        if self.rest and (self._is_asked or not is_late):
            return ChildStatus(None)
        return ChildStatus(code, last_line(self._log))

    def ask_to_stop(self) -> None:
        """Asks it to save and end.

        A controller asks its GMIs. A command may be a shell, which does not pass a signal on: it
        reaches all of its process group, as Ctrl-C does.
        """
        with suppress(ProcessLookupError, PermissionError):
            if not self._is_client:
                self._process.send_signal(self._stop_signal)
            elif not self._is_asked:  # A second signal could end it before it has saved.
                self._is_asked = True
                os.killpg(self.pid, self._stop_signal)

    def interrupt(self) -> None:
        """Asks it as Ctrl-C does: a controller then lets its GMIs take longer."""
        if self._is_client:
            self.ask_to_stop()
            return
        self._pipe.write(INTERRUPT_BYTE)  # No signal: it may have been made to ignore that one.

    def kill(self) -> None:
        """Ends it now, and its process group; GMIs end with their controller."""
        self._killed_s = min(self._killed_s, running_s())
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)

    def close(self) -> None:
        """Call it after its end, or to end it; what is left of its process group ends too."""
        self.kill()
        self._pipe.close()
        has_ended(self._process, self._killed_s + _KILLED_S - running_s())
        self.left = members_of(self.pid)


@contextmanager
def errors_of_one_job(cwd: str | None = None) -> Iterator[None]:
    """Turns what stands in the way of one job's start into a `JobNotStarted`.

    Args:
      cwd: its working folder, which is called so.

    Raises:
      JobNotStarted: with the reason; the next job may start.
      OSError: the next job would fail in the same way.
    """
    try:
        yield
    except ValueError as error:  # What no command may hold, such as a null byte.
        raise JobNotStarted(f"cannot be started ({error})") from None
    except OSError as error:
        if error.errno in _OF_ALL_JOBS:
            raise
        what = "working folder " if cwd is not None and error.filename == cwd else ""
        where = f"{what}{error.filename}: " if error.filename else ""
        raise JobNotStarted(f"cannot be started ({where}{error.strerror})") from None


def _popen(
    process: Process, variables: Mapping[str, str], lifeline: tuple[int, ...]
) -> subprocess.Popen[bytes]:
    """Starts it in a process group of its own, which holds its lock."""
    held: tuple[int, ...] = ()
    try:
        if process.lock is not None:
            held = (_locked(process.lock),)
        if process.input_file is not None:
            write_json(*process.input_file)
        with process.log.open("ab") as output:
            return subprocess.Popen(
                [*process.arguments, *map(str, lifeline)],
                env={**os.environ, **variables, **process.variables},
                cwd=process.cwd,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                pass_fds=(*lifeline, *held),
                # Ctrl-C is for the scheduler, which asks its jobs.
                start_new_session=True,
            )
    finally:
        for fd in held:  # The process has its own.
            os.close(fd)


def _locked(path: Path) -> int:
    """A descriptor of the file, which is locked by it.

    Raises:
      JobNotStarted: a process of the job still runs.
    """
    fd = try_lock(path)
    if fd is None:
        raise JobNotStarted(f"a process of an earlier command still runs ({path})")
    return fd
