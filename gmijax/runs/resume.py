"""Finding a checkpoint and checking that it is whole and fits, without loading it. No jax here."""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from gmijax.config import ALGORITHMS, AlgoConfig, EnvConfig, TrainConfig
from gmijax.config.schema import from_dict, from_named, known
from gmijax.errors import ConfigError
from gmijax.runs.folder import META, RunPaths, last_run, read_json

_CHUNK_BYTES: Final = 1 << 20

_MOST_NAMED: Final = 5
"""Runs that one line names."""


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
    # Of the latest episodes before it, None while none had ended.
    mean_return: float | None = None
    # Of the evaluation at `env_steps`, None if there was none.
    eval_return: float | None = None
    # Size in bytes and CRC-32 of every other file, by its path in the checkpoint; empty in
    # those of older versions.
    files: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, object]:
        """Plain data for `meta.json`."""
        return asdict(self)

    @classmethod
    def read(cls, checkpoint: Path) -> CheckpointMeta:
        """Reads the meta data of a checkpoint folder.

        Raises:
          ConfigError: they are not those of a checkpoint.
        """
        try:
            return from_dict(cls, _read_object(checkpoint / META))
        except ConfigError as error:
            raise ConfigError(f"checkpoint {checkpoint}: broken {META} ({error})") from None


class Found(NamedTuple):
    """Checkpoints of a run folder."""

    checkpoint: Path | None  # The newest one that is whole, None if there is none.
    passed_over: tuple[str, ...]  # Newer ones, each with what is wrong with it.


def newest_checkpoint(folder: Path) -> Found:
    """The newest checkpoint of a run folder whose files are as they were written."""
    passed_over: list[str] = []
    for path in sorted(folder.glob(f"checkpoints/[0-9]*/{META}"), reverse=True):
        wrong = what_is_broken(path.parent)
        if wrong is None:
            return Found(path.parent.resolve(), tuple(passed_over))
        passed_over.append(f"checkpoint {path.parent}: passed over, {wrong}")
    return Found(None, tuple(passed_over))


def best_checkpoint(folder: Path) -> Path | None:
    """The best checkpoint of a run folder, by `rank_of`, whose files are as they were written."""
    found = sorted(meta.parent for meta in folder.glob(f"checkpoints/[0-9]*/{META}"))
    ranked = sorted(reversed(found), key=rank_of, reverse=True)
    return next((path.resolve() for path in ranked if what_is_broken(path) is None), None)


def best_evaluation(folder: Path, env_steps: int) -> float:
    """The best mean return of the evaluations of a run folder up to `env_steps`, -inf for none.

    Of those that have a checkpoint, and the best one always has.
    """
    metas = folder.glob(f"checkpoints/[0-9]*/{META}")
    found = (rank_of(meta.parent) for meta in metas if int(meta.parent.name) <= env_steps)
    return max((mean for is_evaluated, mean in found if is_evaluated), default=-math.inf)


def rank_of(checkpoint: Path) -> tuple[bool, float]:
    """What checkpoints are ranked by, the best one has the largest.

    Its evaluation; one without comes after all that have one, by its mean return in training.
    """
    try:
        meta = CheckpointMeta.read(checkpoint)
    except ConfigError:
        return False, -math.inf
    if meta.eval_return is not None:
        return True, meta.eval_return
    return False, -math.inf if meta.mean_return is None else meta.mean_return


def what_is_broken(checkpoint: Path) -> str | None:
    """Why a checkpoint cannot be used, None if its files are as they were written."""
    try:
        meta = CheckpointMeta.read(checkpoint)
    except ConfigError as error:
        return str(error).partition(": ")[2]
    for name, wanted in meta.files.items():
        try:
            is_same = file_check(checkpoint / name) == tuple(wanted)
        except OSError as error:
            return f"{name}: {error.strerror}"
        if not is_same:
            return f"{name} is not as it was written"
    return None


def file_check(path: Path) -> tuple[int, int]:
    """Size in bytes and CRC-32 of a file."""
    size = crc = 0
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            size, crc = size + len(chunk), zlib.crc32(chunk, crc)
    return size, crc


def find_checkpoint(wanted: str, key: str) -> Path:
    """The checkpoint that `wanted` names, see `choose_checkpoint`."""
    return choose_checkpoint(wanted, key)[0]


def choose_checkpoint(wanted: str, key: str) -> tuple[Path, tuple[str, ...]]:
    """The checkpoint that `wanted` names, and what was passed over for it (see `Found`).

    A checkpoint folder, a run folder (its newest one that is whole), or `last`: the run below
    `runs/` with the newest checkpoint.

    Raises:
      ConfigError: there is none.
    """
    folder = _named(wanted, key)
    if (folder / META).is_file():
        if wrong := what_is_broken(folder):
            raise ConfigError(f"{key}={wanted}: {wrong}")
        return folder.resolve(), ()
    found = newest_checkpoint(folder)
    if found.checkpoint is None:
        raise ConfigError(
            "; ".join((f"{key}={wanted}: {_no_checkpoint(folder)}", *found.passed_over))
        )
    return found.checkpoint, found.passed_over


def saved_config_of(wanted: str, key: str) -> dict[str, Any]:
    """The configuration of the run that `wanted` names, whole or not; see `find_checkpoint`.

    Raises:
      ConfigError: there is no checkpoint, or it does not lie in the folder of a training run.
    """
    folder = _named(wanted, key)
    metas = (folder / META, *folder.glob(f"checkpoints/[0-9]*/{META}"))
    for meta in metas:
        if meta.is_file():
            return saved_config(meta.parent.resolve())
    raise ConfigError(f"{key}={wanted}: {_no_checkpoint(folder)}")


def _no_checkpoint(folder: Path) -> str:
    """Says that a folder has none, and where there are some if it is that of a sweep."""
    jobs = sorted({meta.parents[2].name for meta in folder.glob(f"*/checkpoints/[0-9]*/{META}")})
    if not jobs:
        return "no checkpoint in this folder"
    more = f" and {len(jobs) - _MOST_NAMED} more" if len(jobs) > _MOST_NAMED else ""
    named = ", ".join(jobs[:_MOST_NAMED])
    return f"no checkpoint in this folder; runs in it that have some: {named}{more}"


def _named(wanted: str, key: str) -> Path:
    folder = last_run(key) if wanted == "last" else Path(wanted)
    if not os.path.isdir(folder):  # Unlike `Path.is_dir` it takes any text.
        raise ConfigError(f"{key}={wanted}: no such folder")
    return folder


def saved_config(checkpoint: Path) -> dict[str, Any]:
    """The configuration of the run that a checkpoint lies in, as plain data.

    Keys that its version of gmijax did not know are missing.

    Raises:
      ConfigError: the checkpoint does not lie in the folder of a training run.
    """
    path = RunPaths(checkpoint.parent.parent).config
    if not path.is_file():
        raise ConfigError(
            f"checkpoint {checkpoint}: no config.json in {path.parent}; "
            "a checkpoint can only be used in its run folder"
        )
    try:
        saved = _read_object(path)
    except ConfigError as error:
        raise ConfigError(f"{path}: broken ({error})") from None
    if not all(isinstance(saved.get(group), dict) for group in ("env", "algo", "run")):
        raise ConfigError(f"{path}: not the configuration of a training run")
    if saved["env"].get("suite") == "custom":
        # A file of which nothing is noted is none that can be recognised.
        saved["env"]["source_sha256"] = saved["env"].get("source_sha256") or ""
    return saved


def trained_config(checkpoint: Path) -> tuple[EnvConfig, AlgoConfig]:
    """Task and algorithm of the run that a checkpoint lies in.

    Keys that this version of gmijax does not know any more are left out.

    Raises:
      ConfigError: the checkpoint does not lie in the folder of a training run.
    """
    saved = saved_config(checkpoint)
    algo, _ = known(ALGORITHMS, saved["algo"], "algo.")
    env, _ = known([EnvConfig], saved["env"], "env.")
    return from_dict(EnvConfig, env, "env."), from_named(ALGORITHMS, algo, "algo.")


def require_known_keys(saved: Mapping[str, Any], what: str) -> None:
    """Raises ConfigError if a run's configuration has keys that this version does not know.

    To train on without them would be another training. Policies act without, see `trained_config`.
    """
    if unknown := _unknown_keys(saved):
        raise ConfigError(
            f"{what}: its config.json has keys that this version does not know: {unknown}; take "
            "them out of that file to go on without them (the policy can be played, exported and "
            "served as it is)"
        )


def left_out(checkpoint: Path) -> str | None:
    """Says which keys `trained_config` leaves out of a run's configuration; None: none."""
    unknown = _unknown_keys(saved_config(checkpoint))
    return f"left out, because this version does not know them: {unknown}" if unknown else None


def _unknown_keys(saved: Mapping[str, Any]) -> str:
    return ", ".join(known([TrainConfig], saved)[1])


def _read_object(path: Path) -> dict[str, Any]:
    try:
        data: object = read_json(path)
    except OSError as error:
        raise ConfigError(f"cannot read it: {error.strerror}") from None
    except ValueError as error:  # Not JSON, or not even text.
        raise ConfigError(f"not JSON: {error}") from None
    if not isinstance(data, dict):
        raise ConfigError("not a JSON object")
    return data
