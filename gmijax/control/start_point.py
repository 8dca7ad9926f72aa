"""Where a training job begins: in which run folder, and from which checkpoint."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from gmijax.config import EnvConfig, TrainConfig
from gmijax.errors import ConfigError
from gmijax.partition.plan import Plan
from gmijax.runs.checkpoints import (
    CheckpointMeta,
    checkpoints_of,
    newest_checkpoint,
    none_is_whole,
)
from gmijax.runs.folder import (
    NO_RUN_FOLDER,
    RUNS,
    RunPaths,
    create_run,
    given_run,
    holds_something_else,
    replays_of,
    require_new_run,
)
from gmijax.runs.history import last_env_steps, read_metrics
from gmijax.runs.names import nearby
from gmijax.runs.result import summary_of
from gmijax.runs.resume import choose_checkpoint
from gmijax.runs.saved_config import (
    config_of_run,
    differences,
    require_known_keys,
    saved_config,
    task_and_algorithm,
    trained_config,
)


class StartPoint(NamedTuple):
    """Where a job begins."""

    # The run folder if it exists already, None if a new one is to be made.
    folder: RunPaths | None = None
    checkpoint: Path | None = None  # What the job continues from, None from its beginning.
    is_complete: bool = False  # Whether the checkpoint has all steps that are wanted.
    notes: tuple[str, ...] = ()  # Sentences for the user.

    def root(self, config: TrainConfig) -> Path:
        """Where the run folder is or will be, or the folder that it will be made in."""
        if self.folder is not None:
            return self.folder.root
        return given_run(config.run.dir, config.run.name) or RUNS

    def open(self, config: TrainConfig) -> RunPaths:
        """The run folder; raises as `create_run`."""
        if self.folder is not None:
            return self.folder
        return create_run(config.run.dir, config.run.name, f"{config.env.slug}-{config.algo.name}")


def find_start_point(config: TrainConfig) -> StartPoint:
    """Reads `run.resume`, `run.dir` and `run.name`; changes nothing on the disk.

    Raises:
      ConfigError: a folder that exists and must not, no checkpoint, or one that does not fit.
    """
    if config.run.resume == "auto":
        return _go_on_or_start(config)
    if config.run.resume is None and (run := _untrained(config)) is not None:
        return StartPoint(run, notes=(f"nothing was trained in {nearby(run.root)} before",))
    require_new_run(config.run.dir, config.run.name, "; run.resume=auto continues in it")
    if config.run.resume is None:
        return StartPoint()
    checkpoint, notes = choose_checkpoint(config.run.resume, "run.resume")
    meta = _require_fit(config, checkpoint, saved_config(checkpoint), config.run.resume)
    if meta.env_steps >= config.num_timesteps:
        raise ConfigError(
            f"num_timesteps={config.num_timesteps}: already trained for {meta.env_steps} steps; "
            "set num_timesteps above that"
        )
    return StartPoint(checkpoint=checkpoint, notes=notes)


def _untrained(config: TrainConfig) -> RunPaths | None:
    """The run folder, if a command has ended there before it trained: its input may be mended."""
    folder = given_run(config.run.dir, config.run.name)
    if folder is None or not os.path.isfile(RunPaths(folder).summary):
        return None
    run = RunPaths(folder.resolve())
    summary = summary_of(run)
    has_ended = "algo" in summary and summary.get("status") in ("failed", "interrupted")
    return run if has_ended and not has_trained(run) else None


def has_trained(run: RunPaths) -> bool:
    """Whether anything was trained in a run folder."""
    # Not from the summary, which may be of an attempt before one that was killed.
    return bool(checkpoints_of(run.root) or read_metrics(run.metrics))


def _go_on_or_start(config: TrainConfig) -> StartPoint:
    folder = given_run(config.run.dir, config.run.name)
    assert folder is not None  # `RunConfig` has checked it.
    shown = f"run.resume=auto: {folder}"
    if not os.path.isdir(folder):  # Unlike `Path.is_dir` it takes any text.
        if os.path.lexists(folder):
            raise ConfigError(f"{shown} is not a folder")
        return StartPoint()
    run = RunPaths(folder.resolve())
    if holds_something_else(run.root, own=run.config, lock=run.lock):
        raise ConfigError(f"{shown} {NO_RUN_FOLDER}")
    if os.path.lexists(run.checkpoints) and not run.checkpoints.is_dir():
        raise ConfigError(f"run.resume=auto: {nearby(run.checkpoints)} is not a folder")
    if not run.config.exists():
        return StartPoint(run)
    saved = config_of_run(run)
    env, algo = task_and_algorithm(saved, run)
    was, wanted = (env.label, algo.name), (config.env.label, config.algo.name)
    if was != wanted:
        raise ConfigError(
            f"{shown} holds a run of {' with '.join(was)}, not {' with '.join(wanted)}"
        )
    require_known_keys(saved, shown)
    found = newest_checkpoint(folder)
    if found.checkpoint is None and found.broken:
        raise ConfigError(
            f"{shown}: {none_is_whole(found)}; to train anew, choose another folder or remove "
            f"{nearby(run.checkpoints)}"
        )
    changes = differences(saved, config, run).values()
    notes = (*found.passed_over, *(f"changed since the run: {text}" for text in changes))
    if found.checkpoint is None:
        return StartPoint(run, notes=(*notes, *_begins_anew(run)))
    meta = _require_fit(config, found.checkpoint, saved, "auto")
    is_complete = meta.env_steps >= config.num_timesteps
    return StartPoint(run, found.checkpoint, is_complete, notes)


def _begins_anew(run: RunPaths) -> tuple[str, ...]:
    """The warning about steps that were trained without a checkpoint, if there are any."""
    if (steps := last_env_steps(run.metrics)) is None:
        return ()
    kept = nearby(run.earlier_metrics(steps))
    return (
        f"warning: no checkpoint in {nearby(run.root)}, training starts at step 0; the metrics of "
        f"the {steps:,} steps before are kept in {kept}",
    )


def replay_line(config: TrainConfig, plan: Plan) -> tuple[str, ...]:
    """What the replays of a job hold, for its user; nothing where it has none."""
    if (replay := config.algo.kept_replay) is None:
        return ()
    own = replay.steps * config.envs_per_gmi
    each = "" if plan.layout.num_gmis == 1 else " in each GMI"
    return (f"replay of {own:,} transitions{each} (MiB: replay/mib in the metrics)",)


def forgotten(config: TrainConfig, plan: Plan) -> str | None:
    """The line about the replay that a job which continues from a checkpoint does not have.

    None where it continues with its whole replay, or never had one.
    """
    replay = config.algo.kept_replay
    if config.run.resume is None or replay is None:
        return None
    checkpoint = Path(config.run.resume)
    is_saved = bool(replays_of(checkpoint))
    if not is_saved:
        why = (
            "is not in the checkpoint (algo.save_replay=true keeps it at the end of a run, or "
            "where it is stopped)"
        )
    elif not replay.is_saved:
        why = "is left out with algo.save_replay=false"
    elif not _environments_go_on(config, plan, checkpoint):
        why = "is of another number of GMIs or environments, or of another physics.impl"
    else:
        return None
    meta, before = CheckpointMeta.read(checkpoint), trained_config(checkpoint)[1].kept_replay
    most = meta.num_gmis * meta.num_envs * (before or replay).steps
    return (
        f"the replay of {min(meta.env_steps, most):,} transitions {why}: it is filled for "
        f"{replay.starts} steps of every environment before learning goes on"
    )


def require_replay_fits(config: TrainConfig, plan: Plan, checkpoint: Path | None) -> None:
    """Raises `ConfigError` where a job would continue with a saved replay of other sizes."""
    replay = config.algo.kept_replay
    if checkpoint is None or replay is None or not replay.is_saved:
        return
    if not replays_of(checkpoint) or not _environments_go_on(config, plan, checkpoint):
        return
    saved = trained_config(checkpoint)[1]
    for key in replay.keys:
        have, want = getattr(saved, key), getattr(config.algo, key)
        if have != want:
            raise ConfigError(
                f"algo.{key}={want}: the replay in the checkpoint has {have}; another is allowed "
                "with algo.save_replay=false, which begins a new one"
            )


def _environments_go_on(config: TrainConfig, plan: Plan, checkpoint: Path) -> bool:
    meta = CheckpointMeta.read(checkpoint)
    was = meta.num_gmis, meta.num_envs, meta.impl
    return was == (plan.layout.num_gmis, config.envs_per_gmi, config.physics.impl)


def _require_fit(
    config: TrainConfig, checkpoint: Path, saved: Mapping[str, Any], wanted: str
) -> CheckpointMeta:
    """The checkpoint's meta data, if the job can resume from it; `saved` is its configuration."""
    meta = CheckpointMeta.read(checkpoint)
    for name, have, want in (
        ("task", meta.env, config.env.label),
        ("algorithm", meta.algo, config.algo.name),
        ("network widths", _shown(meta.hidden), _shown(config.algo.hidden_layer_sizes)),
    ):
        if have != want:
            raise ConfigError(f"run.resume={wanted}: checkpoint of {name} {have}, not {want}")
    trained, algo = task_and_algorithm(saved, RunPaths(checkpoint.parents[1]))
    for key in config.algo.fixed_keys:
        have, want = getattr(algo, key), getattr(config.algo, key)
        if have != want:
            raise ConfigError(f"algo.{key}={want}: a resumed run keeps its {have}")
    for key, have in _memory_of(trained).items():
        if have != _memory_of(config.env)[key]:
            want = getattr(config.env, key)
            raise ConfigError(f"env.{key}={want}: a resumed run keeps its {have}")
    seed = saved.get("seed", config.seed)
    if config.seed != seed:
        raise ConfigError(f"seed={config.seed}: a resumed run keeps its seed {seed}")
    return meta


def _memory_of(env: EnvConfig) -> dict[str, object]:
    """The keys that decide what environments remember, and so what a checkpoint has of them."""
    return {
        "history": env.history,
        "action_repeat": env.action_repeat,
        "curriculum": env.curriculum,
        # Models that are drawn once are not saved.
        "randomize": "episode" if env.randomize == "episode" else "off or on",
    }


def _shown(hidden: tuple[tuple[int, ...], ...]) -> str:
    return " and ".join(":".join(map(str, widths)) for widths in hidden)
