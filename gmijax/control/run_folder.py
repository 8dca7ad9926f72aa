"""What a training job does with its run folder before, between and after its attempts."""

from __future__ import annotations

import dataclasses
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from gmijax.config import TrainConfig
from gmijax.config.typed import typed
from gmijax.control.console import nearby
from gmijax.control.start_point import StartPoint, has_trained
from gmijax.control.summary import train_summary
from gmijax.partition.plan import Plan
from gmijax.runs.checkpoints import CheckpointMeta, checkpoints_of, drop_unfinished
from gmijax.runs.folder import (
    RunPaths,
    add_event,
    given_run,
    read_json,
    remove_temporary,
    write_json,
)
from gmijax.runs.git import record_git
from gmijax.runs.held import OpenFolder, gone_if_unused, locked
from gmijax.runs.history import copy_history, draw_returns, last_env_steps
from gmijax.runs.names import attempt_folders, gmi_folders
from gmijax.runs.resume import choose_checkpoint
from gmijax.runs.saved_config import saved_config
from gmijax.sim import source


class HeldRun(NamedTuple):
    """A run folder that a job holds."""

    run: RunPaths
    notes: Sequence[str]  # What the user should know of it.
    folder: OpenFolder  # To see whether it is still there.


@contextmanager
def opened(config: TrainConfig, start_point: StartPoint) -> Iterator[HeldRun]:
    """The run folder of a job, held while it is entered.

    Raises:
      ConfigError: as `StartPoint.open` and `locked`.
    """
    notes = start_point.notes
    if start_point.checkpoint is not None:
        changed = source.changes(config.env, saved_config(start_point.checkpoint)["env"])
        notes = notes if changed is None else (changed, *notes)
    run = start_point.open(config)

    with (
        locked(run.lock, f"run.dir={nearby(run.root)}") as folder,
        gone_if_unused(run.root, partial(is_needless, config, run)),
    ):
        record_git(run, Path.cwd())
        yield HeldRun(run, notes, folder)


def is_needless(config: TrainConfig, run: RunPaths) -> bool:
    """Whether nothing is in a run folder but what a job writes when it starts.

    Not one that the user has named, which the next command uses; a sweep reads how it has ended.
    """
    is_named = given_run(config.run.dir, config.run.name) is not None
    has_failed = any(attempt_folders(gmi) for gmi in gmi_folders(run.root))
    return not (is_named or has_failed or has_trained(run))


def keep_logs(run: RunPaths) -> None:
    """Moves what the GMIs of a failed attempt have left out of the way of the next one's.

    They go to `attempt_<n>` with the first number that is free: an earlier command may have had
    failed attempts in the same run folder.
    """
    gmis = gmi_folders(run.root)
    number = next(n for n in count() if not any((gmi / f"attempt_{n}").exists() for gmi in gmis))
    for folder in gmis:
        kept = folder / f"attempt_{number}"
        files = [path for path in folder.iterdir() if path.is_file()]
        kept.mkdir()
        for path in files:
            path.rename(kept / path.name)


def drop_half_written(run: RunPaths) -> None:
    """Removes what a killed process has left of files and checkpoints that it was writing."""
    gmis = gmi_folders(run.root)
    attempts = [attempt for gmi in gmis for attempt in attempt_folders(gmi)]
    for folder in (run.root, *gmis, *attempts):
        remove_temporary(folder)
    drop_unfinished(run)


def begin_again(run: RunPaths, checkpoint: Path | None) -> None:
    """Prepares a run folder that exists for a job that continues from a checkpoint, or begins.

    What was trained there without a checkpoint is lost, but not its metrics.
    """
    if checkpoint is None and (steps := last_env_steps(run.metrics)) is not None:
        run.metrics.rename(run.earlier_metrics(steps))
    clear_unfinished(run, checkpoint)


def clear_unfinished(run: RunPaths, checkpoint: Path | None) -> None:
    """Leaves of a run what belongs to a checkpoint.

    No half-written files, no later metrics, and no results of GMIs, which are to train again.
    """
    for gmi in gmi_folders(run.root):
        (gmi / "result.json").unlink(missing_ok=True)
    drop_half_written(run)
    # Written anew from the metrics: event files cannot be cut.
    shutil.rmtree(run.tensorboard, ignore_errors=True)
    steps = 0 if checkpoint is None else CheckpointMeta.read(checkpoint).env_steps
    copy_history(run.metrics, run.metrics, steps)


def started_from(
    config: TrainConfig, checkpoint: Path | None, note: Callable[[str], None] = lambda _: None
) -> TrainConfig:
    """The configuration with `run.resume` as the path of a checkpoint, or null.

    What else it takes from other runs is the path of a checkpoint from then on too, so that all
    GMIs, restarts and resumed runs take the same. `note` takes what was passed over for it.

    Raises:
      ConfigError: there is no such checkpoint.
    """

    def find(wanted: str, key: str) -> Path:
        found, passed_over = choose_checkpoint(wanted, key)
        for text in passed_over:
            note(f"{key}: {text}")
        return found

    resume = None if checkpoint is None else str(checkpoint)
    run = dataclasses.replace(config.run, resume=resume)
    return dataclasses.replace(config, run=run, algo=config.algo.with_checkpoints(find))


def record_end(
    config: TrainConfig,
    plan: Plan,
    run: RunPaths,
    status: str,
    wall_s: float,
    restarts: Sequence[Mapping[str, Any]],
) -> None:
    """Leaves in the run folder how a run has ended; arguments as of `train_summary`."""
    add_event(run.events, status)
    drop_unfinished(run)  # On a full disk they stand in the way of the summary.
    write_json(run.summary, train_summary(config, plan, run, status, wall_s, restarts))
    with suppress(OSError):  # What counts is written.
        draw_returns(run.metrics, run.returns_png, f"{config.env.label}, {config.algo.name}")


def what_is_left(config: TrainConfig, run: RunPaths) -> str:
    """The line about what an interrupted job has left, and how it can be continued."""
    folder, result = nearby(run.root), run.gmi(0).result
    status = read_json(result)["status"] if result.exists() else None
    if status == "completed":
        return f"training was complete: {folder}"
    if checkpoints_of(run.root):
        # These are of the command, and all other keys of the run (`gmijax.cli.saved`).
        words = [config.env.words, f"algo={config.algo.name}"]
        words += [*typed(config.plan), *typed(config.cluster)]
        job = " ".join(words)
        command = f"gmijax train {job} run.dir={shlex.quote(folder)} run.resume=auto"
        if status is None:
            return f"to continue from the last checkpoint: {command}"
        return f"the run is saved. To continue: {command}"
    if is_needless(config, run):
        return "no run folder is left"
    return f"no checkpoint was saved; the run folder stays: {folder}"
