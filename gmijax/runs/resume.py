"""Which checkpoint is meant: that of a folder, the newest of a run, or the last run's."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Final

from gmijax.config.schema import close_name
from gmijax.errors import ConfigError, NoCheckpointYet
from gmijax.runs.checkpoints import (
    CheckpointMeta,
    checkpoints_of,
    newest_checkpoint,
    none_is_whole,
    what_is_broken,
)
from gmijax.runs.folder import META, RUNS, RunPaths, read_json, why_no_folder
from gmijax.runs.held import is_locked
from gmijax.runs.names import nearby, shortened

_MOST_NAMED: Final = 5
"""Runs that one line names."""


def find_checkpoint(wanted: str, key: str) -> Path:
    """The checkpoint that `wanted` names, see `choose_checkpoint`.

    For callers that do not report what was skipped, or have done so before.
    """
    return choose_checkpoint(wanted, key)[0]


def choose_checkpoint(wanted: str, key: str) -> tuple[Path, tuple[str, ...]]:
    """The checkpoint that `wanted` names, and what was passed over for it.

    A checkpoint folder, a run folder (its newest one that is whole), or `last`: the run below
    `runs/` with the newest checkpoint.

    Raises:
      NoCheckpointYet: there is none, and the run is being trained.
      ConfigError: there is none.
    """
    folder = _named(wanted, key)
    if os.path.lexists(folder / META):
        if wrong := what_is_broken(folder):
            raise ConfigError(f"{key}={wanted}: {wrong}")
        return folder.resolve(), ()
    found = newest_checkpoint(folder)
    if wanted == "last" and found.checkpoint is not None:
        newer = newer_than(found.checkpoint)
        return found.checkpoint, (*found.passed_over, *newer)
    if found.checkpoint is None:
        if not found.passed_over and is_training(folder):
            raise NoCheckpointYet(f"{key}={wanted}: {first_checkpoint_of(folder)}", folder)
        why = none_is_whole(found) if found.broken else _no_checkpoint(folder)
        raise ConfigError(f"{key}={wanted}: {why}")
    return found.checkpoint, found.passed_over


def any_checkpoint(wanted: str, key: str) -> Path:
    """A checkpoint of the run that `wanted` names, whole or not; see `choose_checkpoint`.

    Raises:
      ConfigError: there is none.
    """
    folder = _named(wanted, key)
    found = [folder] if os.path.lexists(folder / META) else checkpoints_of(folder)
    if not found:
        raise ConfigError(f"{key}={wanted}: {_no_checkpoint(folder)}")
    return found[-1].resolve()


def _no_checkpoint(folder: Path) -> str:
    """The message that a folder has none, and where some are: in the run, in those of a sweep."""
    if folder == RunPaths(folder.parent).checkpoints and checkpoints_of(folder.parent):
        return f"no checkpoint in this folder; did you mean {folder.parent}?"
    jobs = sorted(path.name for path in _folders_in(folder) if checkpoints_of(path))
    if not jobs:
        return "no checkpoint in this folder"
    named = shortened(jobs, _MOST_NAMED, also=" ")
    return f"no checkpoint in this folder; runs in it that have some: {named}"


def _named(wanted: str, key: str) -> Path:
    if not wanted.strip():  # `Path` takes it for the working folder.
        raise ConfigError(f"{key}={wanted}: must not be empty")
    folder = last_run(key) if wanted == "last" else Path(wanted)
    if not os.path.isdir(folder):  # Unlike `Path.is_dir` it takes any text.
        near = "" if os.path.exists(folder) else _meant(wanted, key)
        raise ConfigError(f"{key}={wanted}: {why_no_folder(folder)}{near}")
    return folder


def _meant(wanted: str, key: str) -> str:
    """`; did you mean ...` for a name that is close to that of a run, or to one that is a word."""
    folder = Path(wanted)
    if os.path.isdir(RUNS / folder):  # As `run.name` has it.
        return f"; did you mean {RUNS / folder}?"
    is_name = folder.parent == Path()
    try:
        folders = [folder.parent, *([RUNS] if is_name else [])]
        near = {path.name: str(path) for parent in folders for path in _folders_in(parent)}
    except (OSError, ValueError):  # Not to be read, or no name that a folder can have.
        near = {}
    if is_name:
        words = ("last", "auto") if key == "run.resume" else ("last",)
        near |= dict(zip(words, words, strict=True))
    close = close_name(folder.name, near)
    return f"; did you mean {near[close]}?" if close else ""


def last_run(key: str) -> Path:
    """The run folder below `RUNS` whose newest checkpoint was written last.

    Raises:
      NoCheckpointYet: there is none, and a run is being trained.
      ConfigError: there is none.
    """
    found = {path: run for run in _folders_in(RUNS) for path in checkpoints_of(run)[-1:]}
    if not found and (unsaved := unsaved_runs()):
        run = unsaved[0]
        raise NoCheckpointYet(f"{key}=last: {run}: {first_checkpoint_of(run)}", run)
    if not found:
        raise ConfigError(
            f"{key}=last: no run with a checkpoint in {RUNS}/; train one: "
            "gmijax train env=ball_balance"
        )
    return found[max(found, key=_written_s)]


def unsaved_runs() -> list[Path]:
    """The run folders below `RUNS` that are being trained and have no checkpoint yet."""
    return [run for run in _folders_in(RUNS) if is_training(run) and not checkpoints_of(run)]


def newer_than(checkpoint: Path) -> tuple[str, ...]:
    """What `last` has passed over below `RUNS` for a checkpoint, in a line; empty: nothing newer.

    Runs without a checkpoint that have ended, and sweeps, in whose folders the runs are.
    """
    since_s, named = _written_s(checkpoint)[0], list[str]()
    for folder in _folders_in(RUNS):
        jobs = [path for job in _folders_in(folder) for path in checkpoints_of(job)[-1:]]
        newest = max(jobs, key=_written_s, default=None)
        if newest is not None and _written_s(newest)[0] > since_s:
            named.append(f"{folder} (a sweep; its newest run: {newest.parents[1]})")
        elif _is_unsaved_training(folder) and _begun_s(folder) > since_s:
            named.append(f"{folder} (no checkpoint)")
    if not named:
        return ()
    run = nearby(checkpoint.parents[1])
    return (f"last is {run}; newer, but passed over: {shortened(named, _MOST_NAMED)}",)


def _is_unsaved_training(folder: Path) -> bool:
    """Whether a training run has ended in a folder without a checkpoint."""
    paths = RunPaths(folder)
    if not paths.plan.exists() or checkpoints_of(folder) or is_training(folder):
        return False
    with suppress(ConfigError):
        return "algo" in read_json(paths.config)  # Not so of `gmijax serve`.
    return False


def _begun_s(folder: Path) -> float:
    return os.lstat(RunPaths(folder).config).st_mtime


def is_training(folder: Path) -> bool:
    """Whether a job trains in a run folder now."""
    paths = RunPaths(folder)
    return os.path.isfile(paths.config) and is_locked(paths.lock)


def first_checkpoint_of(folder: Path) -> str:
    """When a run that is being trained saves its first checkpoint, in words."""
    every = None
    with suppress(ConfigError, LookupError, TypeError):
        every = read_json(RunPaths(folder).config)["run"]["checkpoint_every"]
    when = f"after {every} iterations (run.checkpoint_every)" if every else "when it ends"
    return f"still training, no checkpoint yet; the first is saved {when}"


def _written_s(checkpoint: Path) -> tuple[float, float]:
    """When a checkpoint was written; of a run and its copy, which have one time, the run is older.

    Not the time of a folder: that changes with whatever is put into it later, e.g. films.
    """
    file_s = os.lstat(checkpoint / META).st_mtime
    try:
        noted_s = CheckpointMeta.read(checkpoint).time_s
    except ConfigError:
        noted_s = None
    return (file_s if noted_s is None else noted_s), -file_s


def _folders_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
