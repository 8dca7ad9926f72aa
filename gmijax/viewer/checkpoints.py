"""The checkpoints of a run whose policy can be read without jax, while it is trained. No jax here.

A training removes old checkpoints (`run.keep_checkpoints`): a folder may be gone between looking
and reading.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

from gmijax.errors import ConfigError
from gmijax.player.policy import PlainPolicy, checkpoint_policy
from gmijax.runs.checkpoints import CheckpointMeta, checkpoints_of, what_is_broken
from gmijax.runs.folder import META, POLICY
from gmijax.runs.names import steps_of


class Checkpoints:
    """The checkpoints of a run folder.

    Args:
      run: the folder.
    """

    def __init__(self, run: Path) -> None:
        self.run = run

    def look(self) -> list[Path]:
        """Those that have a `policy.npz`, the fewest steps first."""
        try:
            return [path for path in checkpoints_of(self.run) if os.path.lexists(path / POLICY)]
        except ConfigError:  # The folder of the run is gone.
            return []


def read(checkpoint: Path) -> PlainPolicy | None:
    """The policy of a checkpoint; None: it is gone, damaged, or no policy."""
    if what_is_broken(checkpoint) is not None:  # As `gmijax view` passes it over at its start.
        return None
    try:
        return checkpoint_policy(checkpoint)
    except ConfigError:
        return None


def label(checkpoint: Path) -> str:
    """What a checkpoint is called for people."""
    steps = steps_of(checkpoint.name)
    return checkpoint.name if steps is None else f"{steps:,} steps"


def age_s(checkpoint: Path) -> float | None:
    """How long ago a checkpoint was written, seconds; None: it is gone."""
    try:
        noted_s = CheckpointMeta.read(checkpoint).time_s
        written_s = os.stat(checkpoint / META).st_mtime if noted_s is None else noted_s
    except (ConfigError, OSError):
        return None
    return max(0.0, time.time() - written_s)
