"""Commands that end in time."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import IO

STOP_S = 15.0
"""For a command that meets its deadline to save and end."""


def start(
    command: Sequence[str], variables: Mapping[str, str], output: IO[bytes] | None = None
) -> subprocess.Popen[bytes]:
    """Starts a command.

    Args:
      command: with its arguments.
      variables: of the environment, beside those of this process.
      output: where its output goes; None: where that of this process goes.
    """
    return subprocess.Popen(
        command,
        env={**os.environ, **variables},
        stdout=output,
        stderr=output,
        start_new_session=True,  # So that Ctrl-C comes to it once.
    )


def wait_until(deadline_s: float, *processes: subprocess.Popen[bytes]) -> list[int]:
    """Waits for processes; asks them to save and end in time, or when this is interrupted.

    Those that do not are killed.

    Args:
      deadline_s: on the clock of `time.monotonic`; they are asked `STOP_S` before.
      processes: that were started.

    Returns:
      Their exit codes, negative for a signal.
    """
    try:
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline_s - STOP_S - time.monotonic()))
    finally:
        running = [process for process in processes if process.poll() is None]
        for process in running:
            process.send_signal(signal.SIGINT)
        killed_s = time.monotonic() + STOP_S
        for process in running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, killed_s - time.monotonic()))
            process.kill()
    return [process.wait() for process in processes]


def run_command(
    command: Sequence[str], deadline_s: float, variables: Mapping[str, str] | None = None
) -> int:
    """Runs one command, see `start` and `wait_until`; returns its exit code."""
    return wait_until(deadline_s, start(command, variables or {}))[0]
