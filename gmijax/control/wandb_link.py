"""Starts and ends the process that follows a run for Weights & Biases."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from gmijax.config import TrainConfig
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths
from gmijax.supervise.side_process import SideProcess
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
            "without it, use wandb.mode=off"
        )


@contextmanager
def followed(
    config: TrainConfig, run: RunPaths, checkpoint: Path | None, say: Callable[[str], None]
) -> Iterator[None]:
    """The time in which a run is followed; what goes wrong is one line, and no error.

    Args:
      config: of the run.
      run: its folder.
      checkpoint: what it continues from, if anything: the run of that is continued at Weights &
        Biases too.
      say: takes a line for the user.
    """
    if config.wandb.mode == "off":
        yield
        return
    origin = None if checkpoint is None else RunPaths(checkpoint.parents[1]).wandb
    if origin is not None and origin.exists() and not run.wandb.exists():
        with suppress(OSError):
            shutil.copyfile(origin, run.wandb)
    process = SideProcess(
        "gmijax.workers.wandb_writer",
        run.root,
        run.wandb_log,
        title="Weights & Biases",
        lost="nothing more is sent",
        say=say,
    )
    process.send(json.dumps(to_dict(config)).encode())
    try:
        yield
    finally:
        if not process.end(UPLOAD_TIMEOUT_S):
            say(
                f"Weights & Biases: not all was sent within {UPLOAD_TIMEOUT_S:g} s; "
                f"`wandb sync {run.root / 'wandb'}/*run-*` sends the rest"
            )
