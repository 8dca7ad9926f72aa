"""Starts and ends the process that follows a run for Weights & Biases. No jax here."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from gmijax.config import TrainConfig
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError
from gmijax.machine.processes import GuardPipe
from gmijax.runs.folder import RunPaths
from gmijax.supervise.failures import last_line
from gmijax.version import versions_of

UPLOAD_TIMEOUT_S: Final = 30.0
"""Longest wait for the last upload when training has ended."""


def require_wandb(config: TrainConfig) -> None:
    """Raises ConfigError if it is wanted and not installed."""
    mode = config.wandb.mode
    # Not `find_spec`: a folder ./wandb, as earlier runs leave it, looks like a package.
    if mode != "off" and versions_of(["wandb"])["wandb"] is None:
        raise ConfigError(
            f"wandb.mode={mode}: needs the package wandb (pip install 'gmijax[wandb]'); "
            "allowed without it is off"
        )


@contextmanager
def followed(
    config: TrainConfig, run: RunPaths, checkpoint: Path | None, say: Callable[[str], None]
) -> Iterator[None]:
    """The time in which a run is followed; what goes wrong is one line, and no error.

    Args:
      config: of the run.
      run: its folder.
      checkpoint: what it goes on from, if anything: the run of that is continued at Weights &
        Biases too.
      say: takes a line for the user.
    """
    if config.wandb.mode == "off":
        yield
        return
    pipe = GuardPipe()
    process: subprocess.Popen[bytes] | None = None
    try:
        process = _start(config, run, checkpoint, pipe)
    except OSError as error:
        say(f"Weights & Biases: not started ({error.strerror})")
    finally:
        os.close(pipe.read_end)
    if process is None:
        pipe.close()
        yield
        return
    watcher = threading.Thread(target=_watch, args=(process, run, say), daemon=True)
    watcher.start()
    try:
        yield
    finally:
        pipe.close()
        watcher.join(UPLOAD_TIMEOUT_S)
        if watcher.is_alive():
            say(
                f"Weights & Biases: not all was sent within {UPLOAD_TIMEOUT_S:g} s; "
                f"`wandb sync {run.root / 'wandb'}/*run-*` sends the rest"
            )
            process.kill()


def _start(
    config: TrainConfig, run: RunPaths, checkpoint: Path | None, pipe: GuardPipe
) -> subprocess.Popen[bytes]:
    origin = None if checkpoint is None else RunPaths(checkpoint.parents[1]).wandb
    if origin is not None and origin.exists() and not run.wandb.exists():
        shutil.copyfile(origin, run.wandb)
    with run.wandb_log.open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "gmijax.workers.wandb_writer", str(run.root)],
            stdin=pipe.read_end,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C is not for it: it has a summary to send yet.
        )
    pipe.write(json.dumps(to_dict(config)).encode())
    return process


def _watch(process: subprocess.Popen[bytes], run: RunPaths, say: Callable[[str], None]) -> None:
    if process.wait() > 0:
        say(f"Weights & Biases: nothing more is sent: {last_line(run.wandb_log)}")
    elif process.returncode == 0:
        run.wandb_log.unlink(missing_ok=True)
