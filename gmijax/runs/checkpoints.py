"""A checkpoint of a run: its folder, its meta data, and whether it is whole."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from gmijax.config.schema import from_dict
from gmijax.errors import ConfigError, DamagedFile
from gmijax.runs.folder import (
    META,
    REMOVED,
    UNFINISHED,
    RunPaths,
    open_regular,
    read_json,
)
from gmijax.runs.names import by_steps, nearby, steps_name, steps_of

_CHUNK_BYTES: Final = 1 << 20

_DIGEST: Final = "sha256"
"""Key of `meta.json`."""


@dataclass(frozen=True)
class CheckpointMeta:
    """Meta data of a checkpoint."""

    env: str  # Task name.
    algo: str  # Training algorithm.
    env_steps: int  # Environment steps of the whole job so far.
    num_gmis: int  # K of the job that wrote it.
    num_envs: int  # N of that job, environments per GMI.
    # Widths of the policy and of the value network.
    hidden: tuple[tuple[int, ...], tuple[int, ...]]
    impl: str  # Physics implementation; environment states of one cannot be used by the other.
    # Of the latest episodes before it (`EpisodeWindow`), None while none had ended.
    mean_return: float | None = None
    # Of the evaluation at `env_steps`, None if there was none.
    eval_return: float | None = None
    # Whether `mean_return` is over enough episodes; not known of older versions.
    window_full: bool = False
    # A time limit of all its environments together, in environment steps; None: not known.
    limit_steps: float | None = None
    # As the run was given it; that of the schedule is in the learner's state.
    learning_rate: float | None = None
    # When it was written, seconds since 1970: files get new times when a run is copied.
    time_s: float | None = None
    # Size in bytes and CRC-32 of every other file, by its path in the checkpoint; empty in
    # those of older versions.
    files: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, object]:
        """Plain data for `meta.json`, with a digest of all the rest."""
        data = asdict(self)
        return {**data, _DIGEST: _digest(data)}

    @classmethod
    def read(cls, checkpoint: Path) -> CheckpointMeta:
        """Reads the meta data of a checkpoint folder.

        Raises:
          DamagedFile: they are not those of a checkpoint.
        """
        what = f"checkpoint {nearby(checkpoint)}: broken {META}"
        try:
            data = read_json(checkpoint / META)
            # Those of older versions have none.
            noted = data.pop(_DIGEST, None)
            if noted not in (None, _digest(data)):
                raise ConfigError("not as it was written")
            return from_dict(cls, data)
        except DamagedFile as error:
            raise DamagedFile(what, error.cause) from None
        except ConfigError as error:
            raise DamagedFile(what, str(error)) from None


def _digest(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


class NewestCheckpoint(NamedTuple):
    """Checkpoints of a run folder."""

    checkpoint: Path | None  # The newest one that is whole, None if there is none.
    broken: tuple[tuple[Path, str], ...]  # Newer ones, each with what is wrong with it.

    @property
    def passed_over(self) -> tuple[str, ...]:
        """The broken ones, each in a sentence for the user."""
        return tuple(passed_over(path, wrong) for path, wrong in self.broken)


def passed_over(checkpoint: Path, wrong: str) -> str:
    """The message that a checkpoint is not used, and what is wrong with it."""
    return f"checkpoint {nearby(checkpoint)}: passed over, {wrong}"


def checkpoints_of(folder: Path) -> list[Path]:
    """The checkpoints of a run folder, whole or not, the fewest steps first.

    What has another name than gmijax gives is a user's copy, and none of them.
    """
    found = by_steps(RunPaths(folder).checkpoints)
    return [path for path in found if os.path.lexists(path / META)]


def drop_unfinished(run: RunPaths) -> None:
    """Removes what is left of checkpoints that were being written or removed."""
    for suffix in (UNFINISHED, REMOVED):
        for hidden in by_steps(run.checkpoints, prefix=".", suffix=suffix):
            shutil.rmtree(hidden, ignore_errors=True)


def newest_checkpoint(folder: Path) -> NewestCheckpoint:
    """The newest checkpoint of a run folder whose files are as they were written.

    What has lost its meta data is passed over as any other that is damaged.
    """
    broken: list[tuple[Path, str]] = []
    for checkpoint in reversed(by_steps(RunPaths(folder).checkpoints)):
        wrong = what_is_broken(checkpoint)
        if wrong is None:
            return NewestCheckpoint(checkpoint.resolve(), tuple(broken))
        broken.append((checkpoint, wrong))
    return NewestCheckpoint(None, tuple(broken))


def none_is_whole(found: NewestCheckpoint) -> str:
    """The message that no checkpoint is whole, and what is wrong with the newest one."""
    (newest, wrong), *others = found.broken
    more = f" (and {len(others)} more)" if others else ""
    return f"no checkpoint is whole: {nearby(newest)}: {wrong}{more}"


def what_is_broken(checkpoint: Path) -> str | None:
    """Why a checkpoint cannot be used, None if its files are as they were written."""
    try:
        meta = CheckpointMeta.read(checkpoint)
    except DamagedFile as error:
        return f"broken {META} ({error.cause})"
    if steps_of(checkpoint.name) not in (None, meta.env_steps):  # A copy under such a name.
        return f"{META} is that of {steps_name(meta.env_steps)}"
    return next(
        filter(None, (_broken_file(checkpoint, *item) for item in meta.files.items())), None
    )


def _broken_file(checkpoint: Path, name: str, wanted: tuple[int, ...]) -> str | None:
    try:
        real = os.path.realpath(checkpoint / name)
        if not Path(real).is_relative_to(os.path.realpath(checkpoint)):
            return f"{name} is not a file of it"
        is_same = file_check(Path(real)) == tuple(wanted)
    except OSError as error:
        return f"{name}: {error.strerror}"
    except ValueError as error:  # No name that a file can have.
        return f"{name!r}: {error}"
    return None if is_same else f"{name} is not as it was written"


def file_check(path: Path) -> tuple[int, int]:
    """Size in bytes and CRC-32 of a regular file; raises OSError for anything else."""
    size = crc = 0
    with open_regular(path) as file:
        while chunk := file.read(_CHUNK_BYTES):
            size, crc = size + len(chunk), zlib.crc32(chunk, crc)
    return size, crc
