"""Every key of a configuration with its default and meaning, and the page that `--help` prints."""

from __future__ import annotations

import dataclasses
import itertools
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from rich.console import Console
from rich.table import Table

from gmijax.config.schema import suggestion
from gmijax.errors import ConfigError
from gmijax.sim.registry import missing_of

MANY: Final = 60
"""A command with more keys shows the usual ones unless a topic is named."""

_DEFAULT_WIDTH: Final = 16
"""Of a column that must leave space for meanings in 80 columns."""

USUAL: Final = (
    *("num_envs", "num_timesteps", "seed", "unroll_length", "policy"),
    *("env.randomize", "env.episode_length", "physics.impl"),
    *("algo.learning_rate", "algo.entropy_cost"),
    *("plan.gpus", "plan.gmis_per_gpu", "plan.backend"),
    *("run.dir", "run.name", "run.resume", "run.checkpoint_every", "run.max_restarts"),
    *("output.dir", "eval.every", "eval.video", "wandb.mode"),
    *("sweep.jobs_per_gpu", "sweep.objective", "sweep.sampler", "sweep.trials"),
)
"""What most people set."""


class HelpKey(NamedTuple):
    """A key of a configuration, as `--help` and the reference show it."""

    choice: str  # What it belongs to, e.g. `algo=a3c`, or nothing.
    name: str  # Dotted, e.g. `algo.learning_rate`.
    kind: Any  # Its type.
    default: str  # As it would be written on a command line.
    meaning: str  # One line.
    allowed: tuple[str, ...]  # The only values, if they are few.
    # Smallest, largest (or None), and whether it must be greater than 0.
    limits: tuple[float | None, float | None, bool]


def print_help(
    name: str,
    cls: type[Any],
    defaults_of: Callable[[Sequence[str]], Mapping[str, Any]],
    choices: Callable[[str], Sequence[str]],
    topic: str | None = None,
) -> None:
    """Prints how a command is used, and keys with their defaults and meanings.

    Args:
      name: of the command.
      cls: its keys.
      defaults_of: as of `keys_of`.
      choices: names of a group's files.
      topic: a group of keys, or `all`; None: the usual ones, where there are many.

    Raises:
      ConfigError: there is no such topic.
    """
    table = Table(box=None, pad_edge=False)
    table.add_column("key", no_wrap=True)
    table.add_column("default", overflow="fold", max_width=_DEFAULT_WIDTH)
    table.add_column("meaning", overflow="fold")
    # Those without a group, such as num_timesteps, are looked for most.
    keys, last = sorted(keys_of(cls, defaults_of), key=lambda key: "." in key.name), ""
    shown = _of_topic(keys, topic, topics_of(cls))
    for key in shown:
        if key.choice != last:
            table.add_row(f"with {key.choice}:" if key.choice else "")
        last = key.choice
        allowed = f" ({'|'.join(key.allowed)})" if key.allowed else ""
        table.add_row(key.name, key.default, f"{key.meaning}{allowed}")
    console = Console(highlight=False, markup=False)
    console.print(f"usage: {usage_of(name)}")
    for group in ("env", "algo", "plan") if topic in (None, "all") else (topic,):
        if group in {key.name.split(".")[0] for key in keys} and len(choices(group)) > 1:
            names = choices(group)
            absent = [name for name in names if group == "env" and missing_of(name)]
            marked = ", ".join(f"{name}*" if name in absent else name for name in names)
            console.print(f"\n{group}= one of: {marked}")
            if absent:
                console.print("* not installed: gmijax list-envs prints what to install")
            if group == "env":
                console.print("or env=PATH.py:FUNCTION, a task of your own (docs/custom-task.md)")
                console.print(_whose_defaults(name, keys))
    if any("GMI" in key.meaning for key in shown):
        console.print("\nA GMI is one process on a share of a GPU, or on CPU cores.")
    console.print()
    console.print(table)
    if len(shown) < len(keys):
        topics = ", ".join(topics_of(cls))
        console.print(f"\nmore keys: gmijax {name} --help TOPIC, of {topics}")


def topics_of(cls: type[Any]) -> list[str]:
    """What may stand after `--help`."""
    return [
        *sorted({name.partition(".")[0] for _, name, *_ in _documented(cls) if "." in name}),
        "all",
    ]


def allowed_values(cls: type[Any], key: str) -> list[str]:
    """The values that a key may have, where they are few; of other keys none."""
    kinds = [kind for _, name, kind, _ in _documented(cls) if name == key]
    return list(dict.fromkeys(value for kind in kinds for value in _values_of(kind)))


def _values_of(kind: Any) -> Iterator[str]:
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        for option in typing.get_args(kind):
            yield from _values_of(option)
    elif typing.get_origin(kind) is typing.Literal:
        yield from map(str, typing.get_args(kind))
    elif kind is bool:
        yield from ("true", "false")


def _of_topic(keys: Sequence[HelpKey], topic: str | None, topics: Sequence[str]) -> list[HelpKey]:
    if topic == "all" or (topic is None and len(keys) <= MANY):
        return list(keys)
    if topic is None:
        usual = {key.name: key for key in reversed(keys) if key.name in USUAL}
        return [usual[name]._replace(choice="") for name in USUAL if name in usual]
    found = [key for key in keys if key.name.partition(".")[0] == topic]
    if not found:
        raise ConfigError(f"--help {topic}: no such topic{suggestion(topic, topics)}")
    return found


def _whose_defaults(command: str, keys: Sequence[HelpKey]) -> str:
    task = next(key.default for key in keys if key.name == "env.name")
    one_job = "train" if command == "sweep" else command
    return (
        f"Defaults below are those of {task}; each task has its own: "
        f"gmijax {one_job} env=ant --cfg job prints those of ant"
    )


def usage_of(command: str) -> str:
    """The form of its command line."""
    if command == "pack":
        return "gmijax pack [NAME=VALUE,VALUE ...] [key=value ...] [--json] [-v] -- COMMAND ..."
    return f"gmijax {command} [key=value ...] [-v] [--cfg job] [--help [TOPIC]]"


def keys_of(
    cls: type[Any], defaults_of: Callable[[Sequence[str]], Mapping[str, Any]]
) -> Iterator[HelpKey]:
    """Every key that a user may set, in the order of the dataclasses.

    Args:
      cls: the configuration of a command.
      defaults_of: the values of all keys by dotted name, with some overrides.
    """
    for choice, fields in itertools.groupby(_documented(cls), key=lambda found: found[0]):
        # The same key may have another default there.
        values = defaults_of((choice,) if choice else ())
        for _, name, kind, metadata in fields:
            literal = typing.get_origin(kind) is typing.Literal
            allowed = tuple(map(str, typing.get_args(kind))) if literal else ()
            limits = metadata.get("limits", (None, None, False))
            default = _shown_default(name, values)
            yield HelpKey(choice, name, kind, default, metadata["doc"], allowed, limits)


def _shown_default(key: str, values: Mapping[str, Any]) -> str:
    if key in values:
        value = values[key]
        if isinstance(value, bool):
            return str(value).lower()
        return "null" if value is None else str(value)
    # A group whose keys are the user's to choose: their names help more than all values.
    names = {name.removeprefix(f"{key}.").split(".")[0] for name in values if f"{key}." in name}
    return ", ".join(sorted(names)) or "{}"


def _documented(
    cls: type[Any], prefix: str = "", choice: str = ""
) -> Iterator[tuple[str, str, Any, Mapping[str, Any]]]:
    """Every key: the choice that it belongs to, name, type, its text in `doc`."""
    hints = typing.get_type_hints(cls)
    # Own keys first, then those that it shares with other dataclasses.
    for field in sorted(dataclasses.fields(cls), key=lambda x: x.name not in cls.__annotations__):
        kind = hints[field.name]
        is_union = isinstance(kind, types.UnionType)
        trees = [x for x in (typing.get_args(kind) if is_union else (kind,)) if _is_tree(x)]
        for tree in trees:
            name = typing.get_args(typing.get_type_hints(tree).get("name"))
            chosen = f"{field.name}={name[0]}" if len(trees) > 1 else choice
            yield from _documented(tree, f"{prefix}{field.name}.", chosen)
        if not trees and "doc" in field.metadata:  # Others are not for users to set.
            yield choice, prefix + field.name, kind, field.metadata


def _is_tree(kind: Any) -> bool:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)
