"""Processes of the jobs of a sweep: each is a controller of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gmijax.control.exit_codes import EXIT_INTERRUPTED
from gmijax.errors import GmijaxError
from gmijax.machine.processes import GuardPipe
from gmijax.runs.folder import write_json
from gmijax.supervise.failures import last_line
from gmijax.sweeps.jobs import Job
from gmijax.sweeps.places import Place

MODULE = "gmijax.workers.training_job"


@dataclass
class Child:
    """The process of a job.

    Attributes:
      job: what it trains.
      place: where.
      is_pruned: whether it was asked to end because others are better.
      is_killed: whether it was ended by force, as the whole sweep is.
    """

    job: Job
    place: Place
    log: Path
    process: subprocess.Popen[bytes]
    pipe: GuardPipe
    is_pruned: bool = False
    is_killed: bool = False

    def has_ended(self) -> bool:
        """Whether the process is gone."""
        return self.process.poll() is not None

    def ask_to_stop(self) -> None:
        """Asks it to save and end."""
        with suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Ends it now; its GMIs end with it."""
        self.is_killed = True
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)

    def close(self) -> tuple[bool, str | None]:
        """After its end: whether it was interrupted, and why it failed (None: it did not)."""
        self.pipe.close()
        code = self.process.wait()
        if code == 0:
            return False, None
        if code == EXIT_INTERRUPTED or self.is_killed:
            return True, None
        return False, last_line(self.log).removeprefix("gmijax.train: ") or f"exit code {code}"


def start(
    job: Job,
    place: Place,
    config: Mapping[str, Any],
    order: Path,
    log: Path,
    variables: Mapping[str, str],
) -> Child:
    """Starts a job.

    Args:
      job: what to train.
      place: where it goes.
      config: of the training, with everything that the place decides.
      order: file for what the process is told.
      log: file for what it prints; continued if it exists.
      variables: environment variables beside those of this process.
    """
    write_json(order, {"config": config, "cpus": list(place.cpus)})
    pipe = GuardPipe()
    try:
        with log.open("ab") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", MODULE, str(order), str(pipe.read_end)],
                env={**os.environ, **variables},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                pass_fds=(pipe.read_end,),
                # Ctrl-C is for the sweep, which asks its jobs.
                start_new_session=True,
            )
    except OSError as error:
        pipe.close()
        raise GmijaxError(f"job {job.number}: cannot be started ({error.strerror})") from None
    finally:
        os.close(pipe.read_end)
    return Child(job, place, log, process, pipe)
