"""Processes of jobs on their machine: controllers of training runs, or other commands."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from gmijax.clock import running_s
from gmijax.errors import GmijaxError
from gmijax.machine.processes import GuardPipe, members_of
from gmijax.runs.folder import write_json
from gmijax.supervise.failures import last_line

_STAY_S = 15.0
"""Longest wait for the rest of a process group whose leader has ended."""


class Seen(NamedTuple):
    """What is known of a child.

    Attributes:
      exit_code: None while it runs; negative for the signal that ended it.
      said: the last line that it printed, once it has ended.
    """

    exit_code: int | None
    said: str = ""


class Process(NamedTuple):
    """What runs one job, or several together.

    Attributes:
      name: of the job, in messages.
      arguments: of the command.
      log: file for what it prints; continued if it exists.
      variables: environment variables beside those of this process, and those of its place.
      cwd: its working folder; None: that of this process.
      order: a file, and what the process finds in it.
      has_lifeline: whether its last argument is to be the number of a pipe that ends with this
        process.
      is_client: whether the process itself uses its GPU, and starts nothing that has a share.
      memory_fraction: part of the GPU's memory that it may have then; None: not limited.
      stop_signal: asks it to save and end.
    """

    name: str
    arguments: tuple[str, ...]
    log: Path
    variables: Mapping[str, str] = {}
    cwd: str | None = None
    order: tuple[Path, Mapping[str, Any]] | None = None
    has_lifeline: bool = False
    is_client: bool = False
    memory_fraction: float | None = None
    stop_signal: int = signal.SIGTERM


class Child:
    """The process of a job, or of several that are trained together.

    Args:
      process: what is run.
      variables: environment variables of its place.

    Raises:
      GmijaxError: it cannot be started.
    """

    def __init__(self, process: Process, variables: Mapping[str, str]) -> None:
        self._log, self._stop_signal = process.log, process.stop_signal
        self._pipe = GuardPipe()
        self._ended_s: float | None = None
        lifeline = (self._pipe.read_end,) if process.has_lifeline else ()
        try:
            if process.order is not None:
                write_json(*process.order)
            with process.log.open("ab") as output:
                self._process = subprocess.Popen(
                    [*process.arguments, *map(str, lifeline)],
                    env={**os.environ, **variables, **process.variables},
                    cwd=process.cwd,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    pass_fds=lifeline,
                    # Ctrl-C is for the scheduler, which asks its jobs.
                    start_new_session=True,
                )
        except OSError as error:
            self._pipe.close()
            raise GmijaxError(f"{process.name}: cannot be started ({error.strerror})") from None
        finally:
            os.close(self._pipe.read_end)

    @property
    def pid(self) -> int:
        """Its number; that of its process group too."""
        return self._process.pid

    def look(self) -> Seen:
        """How it is; it has ended when its process group has, or is late with that."""
        code = self._process.poll()
        if code is None:
            return Seen(None)
        self._ended_s = self._ended_s or running_s()
        if members_of(self.pid) and running_s() - self._ended_s < _STAY_S:
            return Seen(None)
        return Seen(code, last_line(self._log))

    def ask_to_stop(self) -> None:
        """Asks it to save and end."""
        with suppress(ProcessLookupError):
            self._process.send_signal(self._stop_signal)

    def kill(self) -> None:
        """Ends it now, and its process group; GMIs end with their controller."""
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)

    def close(self) -> None:
        """After its end; what is left of its process group ends too."""
        self.kill()
        self._pipe.close()
        self._process.wait()
