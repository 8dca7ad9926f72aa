"""Processes beside a job that can do without them: what goes wrong is a line."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from gmijax.clock import wait_for
from gmijax.errors import with_type
from gmijax.machine.interpreter import command
from gmijax.machine.processes import GuardPipe
from gmijax.supervise.failures import last_line, signal_name

_KILLED_S: Final = 5.0
"""Longest wait for the end of a process that was killed: a driver may hold it."""


class SideProcess:
    """A module that runs on a run folder until its standard input ends.

    That ends with the job, however the job ends.

    Args:
      module: what to run.
      folder: its only argument.
      log: where its output goes; removed if it ends well.
      title: what it does, for lines to the user.
      lost: what is lost if it fails, for the same.
      say: takes a line for the user.
      environment: its variables; None: those of this process.
    """

    def __init__(
        self,
        module: str,
        folder: Path,
        log: Path,
        *,
        title: str,
        lost: str,
        say: Callable[[str], None],
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._log, self._what, self._say = log, f"{title}: {lost}", say
        self._pipe = GuardPipe()
        self._watcher: threading.Thread | None = None
        try:
            with log.open("wb") as output:
                self._process = subprocess.Popen(
                    command(module, str(folder)),
                    stdin=self._pipe.read_end,
                    stdout=output,
                    stderr=output,
                    env=environment,
                    start_new_session=True,  # Ctrl-C is not for it: it may have work to finish.
                )
        except OSError as error:
            say(f"{title}: not started ({error.strerror})")
        else:
            self._watcher = threading.Thread(target=self._watch, daemon=True)
            self._watcher.start()
        finally:
            os.close(self._pipe.read_end)

    def send(self, data: bytes) -> None:
        """Sends bytes to its standard input."""
        self._pipe.write(data)

    def end(self, timeout_s: float) -> bool:
        """Ends its standard input, and kills it if it has not ended in time.

        Returns:
          Whether it had.
        """
        self._pipe.close()
        if self._watcher is None:
            return True
        is_late = not wait_for(self._has_ended, timeout_s)
        if is_late:
            self._say = _nothing
            self._process.kill()
            self._watcher.join(_KILLED_S)
        return not is_late

    def _has_ended(self, wait_s: float) -> bool:
        assert self._watcher is not None
        self._watcher.join(wait_s)
        return not self._watcher.is_alive()

    def _watch(self) -> None:
        exit_code = self._process.wait()
        if exit_code == 0:
            self._log.unlink(missing_ok=True)
        else:
            how = f"exit code {exit_code}" if exit_code > 0 else signal_name(-exit_code)
            self._say(f"{self._what}: {last_line(self._log) or how}")


def exit_code_beside(work: Callable[[], None]) -> int:
    """Does the work of such a process; returns its exit code: 0, or 1 with a line on stderr."""
    try:
        work()
    # Whatever it is, training continues without it.
    except Exception as error:
        sys.stderr.write(with_type(type(error).__name__, " ".join(str(error).split())) + "\n")
        return 1
    return 0


def _nothing(_: str) -> None:
    """Prints nothing."""
