"""The configuration that a run was trained with, as its folder has it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from gmijax.config import ALGORITHMS, AlgoConfig, EnvConfig, TrainConfig
from gmijax.config.removed import REMOVED, without_removed
from gmijax.config.schema import flatten, from_dict, from_named, known, to_dict
from gmijax.errors import ConfigError, MissingKey
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.names import nearby
from gmijax.runs.resume import any_checkpoint

_OWN_KEYS: Final = ("run.dir", "run.name", "run.resume", "run.profile", "env.source_sha256")
"""Keys that every job has for itself, or for which another message exists."""


def saved_config_of(wanted: str, key: str) -> dict[str, Any]:
    """The configuration of the run that `wanted` names, whole or not; see `find_checkpoint`.

    Raises:
      ConfigError: there is no checkpoint, or it does not lie in the folder of a training run.
    """
    return saved_config(any_checkpoint(wanted, key))


def saved_config(checkpoint: Path) -> dict[str, Any]:
    """The configuration of the run that a checkpoint lies in, see `config_of_run`.

    Raises:
      ConfigError: the checkpoint does not lie in the folder of a training run.
    """
    run = RunPaths(checkpoint.parent.parent)
    if not os.path.lexists(run.config):
        raise ConfigError(
            f"checkpoint {nearby(checkpoint)}: no config.json in {nearby(run.root)}; "
            "a checkpoint can only be used in its run folder"
        )
    return config_of_run(run)


def config_of_run(run: RunPaths) -> dict[str, Any]:
    """The configuration of a run that has one, with or without checkpoints, as plain data.

    Keys that its version of gmijax did not know are missing, and so are removed ones with the
    value that every job now has.

    Raises:
      ConfigError: it is not that of a training run.
    """
    saved = without_removed(read_json(run.config))
    if not all(isinstance(saved.get(group), dict) for group in ("env", "algo", "run")):
        raise ConfigError(f"{nearby(run.config)}: not the configuration of a training run")
    if saved["env"].get("suite") == "custom":
        # A file of which nothing is noted is none that can be recognised.
        saved["env"]["source_sha256"] = saved["env"].get("source_sha256") or ""
    return saved


def require_own_values(
    config: Mapping[str, Any], run: RunPaths, command: Mapping[str, Any], saved: Mapping[str, Any]
) -> None:
    """Names a run's file as the source of a wrong value that a resumed training takes from it.

    Args:
      config: of the training, as plain data.
      run: whose file it is.
      command: the same without what the run has saved.
      saved: the same without what the command line changes.

    Raises:
      ConfigError: names the file; wrong values of the command line are found later.
    """
    wrong = _why_wrong(config)
    if wrong is not None and wrong == _why_wrong(saved) and wrong != _why_wrong(command):
        raise ConfigError(f"{nearby(run.config)}: {wrong}")


def _why_wrong(config: Mapping[str, Any]) -> str | None:
    try:
        from_dict(TrainConfig, config)
    except ConfigError as error:
        return str(error)
    return None


def trained_config(checkpoint: Path) -> tuple[EnvConfig, AlgoConfig]:
    """Task and algorithm of the run that a checkpoint lies in.

    Raises:
      ConfigError: the checkpoint does not lie in the folder of a training run, or its file has a
        wrong value of them.
    """
    return task_and_algorithm(saved_config(checkpoint), RunPaths(checkpoint.parents[1]))


def task_and_algorithm(saved: Mapping[str, Any], run: RunPaths) -> tuple[EnvConfig, AlgoConfig]:
    """Task and algorithm of the saved configuration of a run.

    Keys that this version of gmijax does not know any more are left out. A key with a default in
    its class is as it was before there was such a key; of any other it is unknown what a run
    without it did.

    Raises:
      ConfigError: names the run's file, and a key of it that is missing or has a wrong value.
    """
    try:
        algo, _ = known(ALGORITHMS, saved["algo"], "algo.")
        env, _ = known([EnvConfig], saved["env"], "env.")
        return from_dict(EnvConfig, env, "env."), from_named(ALGORITHMS, algo, "algo.")
    except MissingKey as error:
        raise ConfigError(
            f"{nearby(run.config)}: {error}, as in a run of another version; add it to that file "
            "with the value that the run was trained with (gmijax train env=TASK algo=NAME "
            "--cfg job prints that of this version)"
        ) from None
    except ConfigError as error:
        raise ConfigError(f"{nearby(run.config)}: {error}") from None


def require_known_keys(saved: Mapping[str, Any], what: str) -> None:
    """Raises ConfigError if a run's configuration has keys that this version does not know.

    To train on without them would be another training. Policies act without, see `trained_config`.
    """
    try:
        unknown = _unknown_keys(saved)
    except ConfigError as error:
        raise ConfigError(f"{what}: its config.json: {error}") from None
    if unknown:
        write = [f"{key}: {REMOVED[key].write}" for key in flatten(saved) if key in REMOVED]
        raise ConfigError(
            f"{what}: its config.json has keys that this version does not know: {unknown}; take "
            "them out of that file to go on without them (the policy can be played, exported and "
            f"served as it is){''.join(f'; {line}' for line in write)}"
        )


def differences(saved: Mapping[str, Any], config: TrainConfig, run: RunPaths) -> dict[str, str]:
    """What a job does otherwise than a run, a sentence by key.

    Args:
      saved: the run's configuration. Keys of task and algorithm that its version did not have are
        as they were without.
      config: that of the job.
      run: whose configuration it is.

    Raises:
      ConfigError: as `task_and_algorithm`.
    """
    env, algo = task_and_algorithm(saved, run)
    whole = {**saved, "env": to_dict(env), "algo": to_dict(algo)}
    # As both are after a round trip through JSON.
    before, now = (flatten(json.loads(json.dumps(one))) for one in (whole, to_dict(config)))
    return {
        key: f"{key} is {now.get(key)!r}, was {before.get(key)!r}"
        for key in dict.fromkeys((*now, *before))
        if now.get(key) != before.get(key)
        # The value that was decided for `auto` is no different setting.
        and key not in _OWN_KEYS
        and now.get(key) != "auto"
    }


def left_out(checkpoint: Path) -> str | None:
    """The message with the keys that `trained_config` leaves out of a configuration, if any."""
    unknown = _unknown_keys(saved_config(checkpoint))
    return f"left out, because this version does not know them: {unknown}" if unknown else None


def _unknown_keys(saved: Mapping[str, Any]) -> str:
    return ", ".join(known([TrainConfig], saved)[1])
