"""From `key=value` overrides to a checked configuration, by hydra."""

from __future__ import annotations

import dataclasses
import functools
import re
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, TypeVar, overload

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.conf import HydraConf
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gmijax.cli.arguments import parse, readable, require_text
from gmijax.cli.groups import choices, config_dir
from gmijax.cli.near_key import near_key
from gmijax.cli.saved import NAMED_BY_TASK, as_the_run_was, copy_key, with_saved
from gmijax.config import EnvConfig, ServeConfig, TrainConfig
from gmijax.config.env import choice_of
from gmijax.config.removed import require_not_removed
from gmijax.config.schema import convert, flatten, from_dict, known, require_between, suggestion
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths
from gmijax.runs.resume import any_checkpoint
from gmijax.runs.saved_config import (
    require_known_keys,
    require_own_values,
    saved_config,
    saved_config_of,
    trained_config,
)
from gmijax.sim.registry import SUITES
from gmijax.sim.robots import robot_name
from gmijax.sim.source import names_file, reference, split

C = TypeVar("C")

_COMPOSED: Mapping[str, type[Any]] = {
    "train": TrainConfig,
    "search": TrainConfig,
    "serve": ServeConfig,
}

_MOST_STEPS = 900 * 10**9


@overload
def compose(
    *overrides: str,
    command: Literal["train", "search"] = ...,
    env: Callable[..., Any] | None = ...,
) -> TrainConfig: ...


@overload
def compose(
    *overrides: str, command: Literal["serve"], env: Callable[..., Any] | None = ...
) -> ServeConfig: ...


def compose(*overrides: str, command: str = "train", env: Callable[..., Any] | None = None) -> Any:
    """The configuration that `python -m gmijax.train OVERRIDES` (or another command) would run.

    Args:
      overrides: `key=value`.
      command: `train`, `search` (a training job whose `num_envs` and `plan.gmis_per_gpu` are
        `auto`) or `serve`.
      env: a function `make(*, impl, max_envs) -> gmijax.sim.interface.Env` at the top level of a
        file, instead of `env=path/to/file.py:make`.

    Examples:
      >>> compose("env=ant", "num_envs=512").num_envs
      512

    Raises:
      ConfigError: an unknown key, a wrong type or value, or a function that is in no file.
    """
    if wrong := [one for one in overrides if not isinstance(one, str)]:
        raise ConfigError(f"{wrong[0]!r}: expected key=value, a text")
    chosen = () if env is None else (f"env={reference(env)}",)
    if command not in _COMPOSED:
        raise ConfigError(f"command={command}: expected one of {', '.join(_COMPOSED)}")
    return build(command, _COMPOSED[command], (*chosen, *overrides))


def build(name: str, cls: type[C], overrides: Sequence[str]) -> C:
    """The configuration of a command; raises as `compose`."""
    overrides = readable(name, overrides)
    items = parse(overrides)
    if name == "serve" and not _names_policy(items):
        overrides = [*overrides, "run.dir=last"]
        items = parse(overrides)
    data = compose_dict(name, [*_choices_of_run(name, items), *overrides])
    if name == "serve":
        _check_task_key(items)
        data = _with_task_of_run(data, items)
    if _COMPOSED.get(name) is TrainConfig:
        _check_task_key(items)
        resume = data["run"].get("resume") if isinstance(data["run"], dict) else None
        resume = convert(str | None, resume, "run.resume")
        if resume == "auto":
            data = as_the_run_was(data, items, _chosen_only(name, overrides, items))
        elif resume is not None:
            data = _on_top_of_saved(data, items, resume)
    for key, value in flatten(data).items():  # What the environment has may be anything.
        if isinstance(value, str):
            require_text(f"{key}={value}")
    config = from_dict(cls, data)
    _require_steps(config)
    return config


def _require_steps(config: object) -> None:
    if isinstance(config, TrainConfig):
        # The last iteration may go beyond the wanted steps, and checkpoints have twelve digits.
        require_between("num_timesteps", config.num_timesteps, 1, _MOST_STEPS)


def _names_policy(items: Sequence[Override]) -> bool:
    """Whether a command line of `serve` sets which run's policy acts, or that none does."""
    return any(
        item.key_or_group == "run.dir"
        or (item.key_or_group == "policy" and item.value() != "trained")
        for item in items
    )


def _chosen_only(
    name: str, overrides: Sequence[str], items: Sequence[Override]
) -> Callable[[], dict[str, Any]]:
    """Makes what the command would be with its task and algorithm, and without other overrides."""
    choosing = ("env", "env.name", "algo")
    pairs = zip(overrides, items, strict=True)
    kept = [text for text, item in pairs if item.key_or_group in choosing]
    return lambda: compose_dict(name, kept)


def _choices_of_run(name: str, items: Sequence[Override]) -> list[str]:
    """`env=` and `algo=` of the run to resume or to serve: they decide which keys there are."""
    key = {"train": "run.resume", "serve": "run.dir"}.get(name, "")
    given = {item.key_or_group: item.value() for item in items}
    run = convert(str | None, given.get(key), key)
    if not run or run == "auto":
        return []
    saved = saved_config_of(run, key)
    suite, task = saved["env"].get("suite", "gmijax"), saved["env"].get("name")
    chosen = {"env": choice_of(str(suite), str(task))}
    if name == "train":
        chosen["algo"] = saved["algo"].get("name", "ppo")
    return [
        f"{group}={value}"
        for group, value in chosen.items()
        if group not in given and value in choices(group)
    ]


def compose_dict(name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """The plain data of a command's configuration; raises ConfigError."""
    items = parse(overrides)
    for item in items:
        _check_override(name, item)
    chosen = {item.key_or_group: str(item.value()) for item in items}
    _check_terms(name, items, chosen)
    if chosen.get("env") in ("custom", "playground"):
        overrides = [f"++{text}" if text.startswith(NAMED_BY_TASK) else text for text in overrides]
    try:
        with _no_jobs_of_hydra(), initialize_config_dir(str(config_dir()), version_base=None):
            config = hydra_compose(name, overrides=list(overrides))
        data = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except (ValueError, HydraException, OmegaConfBaseException) as error:
        groups = [f"{key}={value}" for key, value in chosen.items() if value in choices(key)]
        raise _refused(name, error, items, groups) from None
    except OSError as error:  # Hydra looks for a file with the name of the key.
        raise ConfigError(f"{max(overrides, key=len, default=name)}: {error.strerror}") from None
    composed = typing.cast("dict[str, Any]", data)
    if chosen.get("env") == "playground" and isinstance(composed["env"].get("settings"), dict):
        # Its configurations have groups, whose names stand in ours with dots.
        composed["env"]["settings"] = flatten(composed["env"]["settings"])
    return composed


@functools.cache
def _bare() -> DictConfig:
    return OmegaConf.structured(HydraConf(defaults=[]))


@contextmanager
def _no_jobs_of_hydra() -> Iterator[None]:
    """Leaves out Hydra's settings of jobs that it runs itself, half of what it would compose.

    The store is restored: it belongs to the process, in which the user may have jobs of Hydra.
    """
    stored = ConfigStore.instance().repo["hydra"]
    whole = stored["config.yaml"]
    stored["config.yaml"] = dataclasses.replace(whole, node=_bare())
    try:
        yield
    finally:
        stored["config.yaml"] = whole


def _check_override(name: str, item: Override) -> None:
    key = item.key_or_group
    if not key:
        raise ConfigError(f"{item.input_line}: expected key=value")
    require_not_removed(key)
    # Hydra's own settings are for jobs that hydra runs; here they would do nothing.
    if re.split(r"[./]", key)[0] == "hydra":
        raise _unknown_key(key, defaults(name, ()))
    if item.is_sweep_override():
        sweep = "; gmijax sweep takes several" if name == "train" else ""
        raise ConfigError(
            f"{item.input_line}: expected one value (a list stands in brackets){sweep}"
        )
    options = choices(key)
    if item.is_delete() and (key == "env" or (key == "algo" and name != "serve")):
        raise ConfigError(f"{item.input_line}: a job needs one; choose it with {key}=NAME")
    if options and item.is_delete() and not isinstance(item.value(), str | None):
        raise ConfigError(f"{item.input_line}: expected ~{key}")
    if options and not item.is_delete() and item.value() not in options:
        # Of a few the closest name is a guess: `algo=td3` is no slip for a3c.
        hint = f": expected one of {', '.join(options)}" if len(options) < 5 else ""
        kind = {"env": " task", "algo": " algorithm"}.get(key, "")
        suite, colon, of_suite = str(item.value()).partition(":")
        if key == "env" and colon and suite in options:  # As labels and run folders have it.
            hint = f": did you mean env={suite} env.name={of_suite}?"
        elif key == "env" and names_file(str(item.value())):
            split(str(item.value()))
        raise ConfigError(
            f"{key}={item.value()}: unknown{kind}{hint or suggestion(str(item.value()), options)}"
        )


def _check_terms(name: str, items: Sequence[Override], chosen: Mapping[str, str]) -> None:
    """Refuses terms of the reward that a robot does not have; `+` would add any."""
    of_playground = chosen.get("env") == "playground"
    robot = robot_name(chosen.get("env.name" if of_playground else "env", ""))
    terms = [item.key_or_group for item in items if item.key_or_group.startswith("env.rewards.")]
    if robot is None or not terms:
        return
    keys = defaults(name, [f"env={robot}"])
    for term in terms:
        if term not in keys:
            raise _unknown_key(term, keys)


def _check_task_key(items: Sequence[Override]) -> None:
    """Refuses `env.name` alone: it would run a task with the settings tuned for another one."""
    groups = {str(item.value()) for item in items if item.key_or_group == "env"}
    for item in items:
        name = str(item.value())
        if item.key_or_group == "env.suite" and name not in groups:
            raise ConfigError(f"env.suite={name}: choose it with env=")
        if item.key_or_group == "env.name" and not groups & {name, *SUITES}:
            raise ConfigError(f"env.name={name}: choose the task with env={name}")


def _unknown_key(key: str, known: Collection[str]) -> ConfigError:
    group, dot, name = key.rpartition(".")
    trained = key.partition(".")[0]
    if trained in ("env", "algo") and name not in known and not _has_group(trained, known):
        return ConfigError(
            f"{key}: this command takes the task and the policy as the run was trained, with its "
            "weights and settings; they cannot be changed here"
        )
    if group + dot in NAMED_BY_TASK:
        names = [one.removeprefix(group + dot) for one in known if one.startswith(group + dot)]
        none = f": this task has none in {group}"
        return ConfigError(f"unknown key {key}{suggestion(name, names) if names else none}")
    if group == "cluster" and not _has_group(group, known):
        return ConfigError(
            f"{key}: this command is for one machine; gmijax.train and gmijax.sweep take several"
        )
    return ConfigError(f"unknown key {key}{near_key(key, set(known))}")


def _has_group(group: str, known: Collection[str]) -> bool:
    return any(one.startswith(f"{group}.") for one in known)


def _on_top_of_saved(
    data: dict[str, Any], items: Sequence[Override], resume: str
) -> dict[str, Any]:
    """The saved configuration of the resumed run, with the changes of the command line.

    What an older version did not save comes from the defaults for the run's own task.
    """
    checkpoint = any_checkpoint(resume, "run.resume")
    run, saved = RunPaths(checkpoint.parents[1]), saved_config(checkpoint)
    require_known_keys(saved, f"run.resume={resume}")
    saved["run"].update(dir=None, name=None, profile=None, resume=resume)
    suite = saved["env"].get("suite", "gmijax")
    merged = with_saved(data, saved)
    for item in items:
        key = item.key_or_group
        if key == "env.name":  # Whatever the file holds by now is meant.
            merged["env"]["source_sha256"] = None
        if (key, item.value()) == ("env", "custom") and suite == "custom":
            continue  # The file may have moved; `env.name` has the new path.
        if copy_key(key, data, merged):
            continue
        if item.is_delete() or choices(key):
            raise ConfigError(
                f"{item.input_line}: a resumed run keeps its settings; "
                "change single keys with key=value"
            )
        raise _unknown_key(key, flatten(data))
    require_own_values(merged, run, data, with_saved(data, saved))
    return merged


def _with_task_of_run(data: dict[str, Any], items: Sequence[Override]) -> dict[str, Any]:
    """With `run.dir` and without `env=`: the task of that run, with the changes of `env.*`."""
    run_dir = data["run"].get("dir") if isinstance(data["run"], dict) else None
    if run_dir is None or any(item.key_or_group == "env" for item in items):
        return data
    checkpoint = any_checkpoint(str(run_dir), "run.dir")
    trained_config(checkpoint)  # What is wrong in its file is not the command's mistake.
    saved, _ = known([EnvConfig], saved_config(checkpoint)["env"])
    # A policy that has learnt needs no easy episodes, unless they are asked for.
    saved["curriculum"] = data["env"]["curriculum"]
    merged = {**data, "env": {**data["env"], **saved}}
    for item in items:
        if item.key_or_group.startswith("env."):
            copy_key(item.key_or_group, data, merged)
    return merged


def _refused(
    name: str, error: Exception, items: Sequence[Override], groups: Sequence[str]
) -> ConfigError:
    text = " ".join(str(error).split())
    if match := re.search(r"Key '([^']+)' is not in struct full_key: (\S+)", text):
        return _unknown_key(match[2], defaults(name, groups))
    if match := re.search(r"Could not override '([^']+)'", text):
        # It may be one of the groups: without it, or this would be asked again and again.
        others = [group for group in groups if group.partition("=")[0] != match[1]]
        return _unknown_key(match[1], defaults(name, others))
    known = defaults(name, groups)
    for item in items:  # A word or a number below a list or a value.
        key = item.key_or_group
        if any(key.startswith(f"{one}.") for one in known):
            return _unknown_key(key, known)
    return ConfigError(text)


def defaults(name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """The values of all keys of a command, by dotted name, with some overrides."""
    return flatten(compose_dict(name, overrides))
