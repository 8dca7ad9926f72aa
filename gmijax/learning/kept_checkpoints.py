"""Which checkpoints of a run stay when there is another one."""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path

from gmijax.errors import ConfigError
from gmijax.runs.checkpoints import CheckpointMeta, checkpoints_of
from gmijax.runs.folder import META, RunPaths, replays_of, write_json
from gmijax.runs.ranking import ranked


def keep_best(paths: RunPaths, keep: int, last: Path) -> None:
    """Leaves so many checkpoints up to `last`: that, the best one (`ranked`), the newest ones."""
    # Later ones, which a restart has skipped, do not count.
    checkpoints = [path for path in checkpoints_of(paths.root) if path.name <= last.name]
    best = ranked(checkpoints)[0][1]
    others = [path for path in checkpoints if path != best]
    num_others = max(keep - 1, int(best != last))
    for path in others[: max(0, len(others) - num_others)]:
        remove(paths, path)


def keep_last_replays(paths: RunPaths, last: Path) -> None:
    """Replays are kept in one checkpoint alone: they are many times as large as all else."""
    for checkpoint in checkpoints_of(paths.root):
        replays = replays_of(checkpoint)
        if checkpoint == last or not replays:
            continue
        try:
            meta = CheckpointMeta.read(checkpoint)
        except ConfigError:  # A damaged one: a resume names it.
            continue
        # First the list of files, so that it is a whole checkpoint at any time.
        names = {path.name for path in replays}
        files = {
            name: check for name, check in meta.files.items() if name.split("/")[0] not in names
        }
        write_json(checkpoint / META, dataclasses.replace(meta, files=files).to_dict())
        for path in replays:
            hidden = path.with_name(f".{path.name}")
            os.replace(path, hidden)
            shutil.rmtree(hidden, ignore_errors=True)


def remove(paths: RunPaths, checkpoint: Path) -> None:
    """Removes a checkpoint, which is there as a whole or not at all."""
    # Under another name first: what has lost some of its files is no checkpoint.
    hidden = paths.removed(int(checkpoint.name))
    shutil.rmtree(hidden, ignore_errors=True)
    os.replace(checkpoint, hidden)
    shutil.rmtree(hidden, ignore_errors=True)
