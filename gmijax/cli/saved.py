"""Configurations of runs that are gone on with: what was saved, and what this command changes."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from hydra.core.override_parser.types import Override

from gmijax.config.schema import convert, flatten
from gmijax.runs.folder import RunPaths, given_run
from gmijax.runs.saved_config import config_of_run, require_known_keys, require_own_values

NAMED_BY_TASK: Final = ("env.rewards.", "env.settings.")
"""Groups of keys whose names, which may have dots, are the task's; those of tasks of others only
these know."""

_OF_THE_COMMAND: Final = (
    *("run.dir", "run.name", "run.resume", "run.profile"),
    *("env.suite", "env.name", "env.source_sha256", "algo.name"),
)
"""Keys that are not taken from a run: where it continues, and its task and algorithm."""

_OF_THE_MACHINE: Final = ("plan", "cluster", "search")
"""Groups that set where a job runs, which may be elsewhere each time."""


def as_the_run_was(
    data: dict[str, Any], items: Sequence[Override], defaults: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    """The configuration of a command with `run.resume=auto`, as of the run in its folder.

    What the command sets, by itself or by a file that it chooses, is as set there. All else is as
    the run has it, so that another version with other defaults does not train it otherwise.

    Args:
      data: of the command, with all defaults.
      items: its overrides.
      defaults: makes the same without any override but those that choose task and algorithm.

    Returns:
      `data` if there is no run yet, or one of another task or algorithm, which is refused later.

    Raises:
      ConfigError: the run's configuration is broken, or has keys that this version does not know;
        or the command does not name a folder.
    """
    if not all(isinstance(data[group], dict) for group in ("run", "env", "algo")):
        return data  # Refused later.
    folder = given_run(*(convert(str | None, data["run"][k], f"run.{k}") for k in ("dir", "name")))
    if folder is None or not os.path.isdir(folder):
        return data
    paths = RunPaths(Path(folder))
    if not os.path.lexists(paths.config):
        return data
    saved = config_of_run(paths)
    if not _is_alike(data, saved):
        return data
    require_known_keys(saved, f"run.resume=auto: {folder}")
    merged = with_saved(data, saved)
    for group in _OF_THE_MACHINE:
        merged[group] = data[group]
    own, without = flatten(data), flatten(defaults())
    changed = [key for key, value in own.items() if key not in without or without[key] != value]
    named = [item.key_or_group for item in items if item.key_or_group not in ("env", "algo")]
    for key in (*_OF_THE_COMMAND, *changed, *named):
        copy_key(key, data, merged)
    require_own_values(merged, paths, data, with_saved(data, saved))
    return merged


def _is_alike(data: Mapping[str, Any], saved: Mapping[str, Any]) -> bool:
    """Whether both have one task and one algorithm: others have other keys."""
    suite = saved["env"].get("suite", "gmijax")
    # That of a custom task may have moved; whether it is the same is asked when it is found.
    is_task = suite == "custom" or data["env"]["name"] == saved["env"].get("name")
    found = data["env"].get("suite", "gmijax"), data["algo"]["name"]
    return is_task and found == (suite, saved["algo"].get("name", "ppo"))


def with_saved(data: Mapping[str, Any], saved: Mapping[str, Any]) -> dict[str, Any]:
    """What a run has saved, filled up with what an older version did not save."""
    merged = _merged(data, saved)
    if "randomization" in saved["env"]:  # A leaf that the run left out stays out.
        merged["env"]["randomization"] = saved["env"]["randomization"]
    return merged


def _merged(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `top`, group by group."""
    merged = {**base, **top}
    for key in base.keys() & top.keys():
        if isinstance(base[key], Mapping) and isinstance(top[key], Mapping):
            merged[key] = _merged(base[key], top[key])
    return merged


def copy_key(key: str, source: dict[str, Any], target: dict[str, Any]) -> bool:
    """Copies the value or group of a dotted key; returns whether `source` has it."""
    *groups, last = key.split(".", 2 if key.startswith(NAMED_BY_TASK) else -1)
    for group in groups:
        source, target = source.get(group, {}), target.get(group, {})
        if not (isinstance(source, dict) and isinstance(target, dict)):
            return False
    if last in source:
        target[last] = source[last]
    return last in source
