"""Which run, checkpoint and task a command that takes a trained policy means."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final, TypeVar

from gmijax.config import EnvConfig, ExportConfig, PlayConfig, ViewConfig
from gmijax.deploy.output import prepare_output
from gmijax.deploy.shipped import SHIPPED
from gmijax.errors import ConfigError
from gmijax.runs.checkpoints import CheckpointMeta, checkpoints_of
from gmijax.runs.folder import META, RunPaths
from gmijax.runs.names import nearby, steps_name
from gmijax.runs.ranking import choose_best, ranked
from gmijax.runs.resume import (
    choose_checkpoint,
    find_checkpoint,
    first_checkpoint_of,
    unsaved_runs,
)
from gmijax.runs.saved_config import left_out, trained_config
from gmijax.sim import source
from gmijax.sim.registry import require_env, require_own

C = TypeVar("C", PlayConfig, ExportConfig, ViewConfig)

_MOST_DIGITS: Final = 18
"""Of env steps; a longer number is no file name."""


def open_run(config: C) -> tuple[C, EnvConfig, str | None]:
    """Finds and checks the checkpoint, run and task of a configuration.

    All before a process is started, which would find them bad too.

    Returns:
      The configuration with what was found, the task, and what the user should know before it is
      executed, also what is not as the run had it (None if nothing).

    Raises:
      NoCheckpointYet: the run is being trained, and has none yet.
      ConfigError: no such run or checkpoint, or its task cannot be had.
    """
    if config.run.env is not None and source.names_file(config.run.env):
        source.split(config.run.env)
    elif config.run.env is not None:
        hint = f"; to play the policy that comes with gmijax, add checkpoint={SHIPPED}"
        why = "not needed, a run knows its task" + (
            "" if isinstance(config, ExportConfig) else hint
        )
        raise ConfigError(f"env={config.run.env}: {why}")
    checkpoint, passed_over = checkpoint_of(config)
    early = None
    is_last = config.checkpoint in (None, "best") and config.run.dir in (None, "last")
    if config.checkpoint == "best" and not ranked([checkpoint])[0][0].is_full:
        early = (
            "checkpoint=best: none has an evaluation or a full window of episodes to compare by"
        )
    saved, _ = trained_config(checkpoint)
    if isinstance(config, ViewConfig):  # Before its file is asked for: it is not executed.
        require_own(saved)
    env = source.opened(saved, config.run.env)
    require_env(env)
    run = dataclasses.replace(config.run, dir=str(checkpoint.parents[1]))
    if env.suite == "custom":
        run = dataclasses.replace(run, env=env.name, env_sha256=env.source_sha256)
    config = dataclasses.replace(config, checkpoint=str(checkpoint), run=run)
    notes = (
        source.executed(env),
        source.changes(env, dataclasses.asdict(saved)),
        left_out(checkpoint),
        early,
        *(f"{run}: {first_checkpoint_of(run)}" for run in (unsaved_runs() if is_last else ())),
        *passed_over,
    )
    return config, env, "\n".join(filter(None, notes)) or None


def checkpoint_of(config: PlayConfig | ExportConfig | ViewConfig) -> tuple[Path, tuple[str, ...]]:
    """The checkpoint that the configuration names, and what was passed over for it."""
    wanted, run_dir = config.checkpoint, config.run.dir
    if wanted in (None, "best") or (wanted.isdecimal() and len(wanted) <= _MOST_DIGITS):
        latest, passed_over = choose_checkpoint(run_dir or "last", "run.dir")
        if wanted is None:
            return latest, passed_over
        if wanted != "best":  # Nothing else was meant.
            return _at_step(latest.parents[1], int(wanted)), ()
        best, better = choose_best(latest.parents[1])
        return best or latest, tuple(dict.fromkeys((*passed_over, *better)))
    if not os.path.isfile(Path(wanted) / META):  # Unlike `Path.is_file` it takes any text.
        raise ConfigError(
            f"checkpoint={wanted}: expected the folder of a checkpoint, its env steps, or best"
        )
    checkpoint = Path(wanted).resolve()
    if run_dir is not None:
        latest = find_checkpoint(run_dir, "run.dir")
        if latest.parents[1] != checkpoint.parents[1]:
            raise ConfigError(
                f"checkpoint={wanted}: not of run.dir={run_dir}; leave out one of them"
            )
    return checkpoint, ()


def _at_step(run: Path, env_steps: int) -> Path:
    checkpoint = RunPaths(run).checkpoint(env_steps)
    if not (checkpoint / META).is_file():
        steps = ", ".join(str(int(path.name)) for path in checkpoints_of(run))
        raise ConfigError(
            f"checkpoint={env_steps}: no such checkpoint in {nearby(run)}; there are {steps}"
        )
    return checkpoint


def output_folder(
    config: PlayConfig | ExportConfig,
    name: str,
    stale: Callable[[Path], Iterable[Path]] = lambda _: (),
) -> Path:
    """Where what is made of a checkpoint goes: `<run>/<name>/<env steps>`, with the configuration.

    Args:
      config: with what `open_run` found.
      name: see above.
      stale: files that may be there from before, in such a folder; they are removed.

    Raises:
      ConfigError: as `prepare_output`.
    """
    run = Path(str(config.run.dir))
    env_steps = CheckpointMeta.read(Path(str(config.checkpoint))).env_steps
    root = run / name / steps_name(env_steps)
    prepare_output(root, config, stale(root))
    return root
