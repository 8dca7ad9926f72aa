"""Processes of the jobs of a sweep, on their machine: each is a controller of its own."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from gmijax.clock import running_s
from gmijax.errors import GmijaxError
from gmijax.machine.interpreter import command
from gmijax.machine.processes import GuardPipe, members_of
from gmijax.runs.folder import write_json
from gmijax.supervise.failures import last_line

MODULE = "gmijax.workers.training_job"

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


class Child:
    """The process of a job, or of several that are trained together.

    Args:
      configs: of the runs, with everything that their place decides.
      cpus: its cores.
      order: file for what the process is told.
      log: file for what it prints; continued if it exists.
      variables: environment variables beside those of this process.

    Raises:
      GmijaxError: it cannot be started.
    """

    def __init__(
        self,
        configs: Sequence[Mapping[str, Any]],
        cpus: tuple[int, ...],
        order: Path,
        log: Path,
        variables: Mapping[str, str],
    ) -> None:
        self._log = log
        self._pipe = GuardPipe()
        self._ended_s: float | None = None
        try:
            write_json(order, {"configs": list(configs), "cpus": list(cpus)})
            with log.open("ab") as output:
                self._process = subprocess.Popen(
                    command(MODULE, str(order), str(self._pipe.read_end)),
                    env={**os.environ, **variables},
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    pass_fds=(self._pipe.read_end,),
                    # Ctrl-C is for the sweep, which asks its jobs.
                    start_new_session=True,
                )
        except OSError as error:
            self._pipe.close()
            raise GmijaxError(f"job {order.stem}: cannot be started ({error.strerror})") from None
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
            self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Ends it now; its GMIs end with it."""
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)

    def close(self) -> None:
        """After its end."""
        self._pipe.close()
        self._process.wait()
