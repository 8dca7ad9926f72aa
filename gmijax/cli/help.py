"""The page that `--help` prints: every key of a configuration, with its default and meaning."""

from __future__ import annotations

import dataclasses
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table


def print_help(
    name: str,
    cls: type[Any],
    defaults_of: Callable[[Sequence[str]], Mapping[str, Any]],
    choices: Callable[[str], Sequence[str]],
) -> None:
    """Prints how a command is used, and every key with its default and meaning."""
    values = defaults_of(())
    table = Table(box=None, pad_edge=False)
    for heading in ("key", "default", "meaning"):
        table.add_column(heading, overflow="fold", no_wrap=heading == "key")
    last, defaults = "", values
    for choice, key, meaning, allowed in _documented(cls):
        if choice != last:
            # The same key may have another default there.
            defaults = defaults_of((choice,)) if choice else values
            table.add_row(f"with {choice}:" if choice else "")
        last = choice
        shown = _shown_default(key, defaults)
        table.add_row(key, shown, f"{meaning}{f' ({allowed})' if allowed else ''}")
    console = Console(width=None if sys.stdout.isatty() else 140, highlight=False, markup=False)
    console.print(f"usage: python -m gmijax.{name} [key=value ...] [--cfg job] [--help]\n")
    for group in ("env", "algo", "plan"):
        if group in {key.split(".")[0] for key in values} and choices(group):
            console.print(f"{group}= one of: {', '.join(choices(group))}")
            if group == "env":
                console.print("or env=PATH.py:FUNCTION, a task of your own (docs/custom-task.md)")
    console.print()
    console.print(table)


def _shown_default(key: str, values: Mapping[str, Any]) -> str:
    if key in values:
        return "null" if values[key] is None else str(values[key])
    # A group whose keys are the user's to choose: their names tell more than all their values.
    names = {name.removeprefix(f"{key}.").split(".")[0] for name in values if f"{key}." in name}
    return ", ".join(sorted(names)) or "{}"


def _documented(
    cls: type[Any], prefix: str = "", choice: str = ""
) -> Iterator[tuple[str, str, str, str]]:
    """Every key: the choice that it belongs to (e.g. `algo=a3c`, or none), name, meaning, type."""
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        kind = hints[field.name]
        is_union = isinstance(kind, types.UnionType)
        trees = [x for x in (typing.get_args(kind) if is_union else (kind,)) if _is_tree(x)]
        for tree in trees:
            name = typing.get_args(typing.get_type_hints(tree).get("name"))
            chosen = f"{field.name}={name[0]}" if len(trees) > 1 else choice
            yield from _documented(tree, f"{prefix}{field.name}.", chosen)
        if trees:
            continue
        literal = typing.get_origin(kind) is typing.Literal
        allowed = "|".join(map(str, typing.get_args(kind))) if literal else ""
        if "doc" in field.metadata:  # Others are not for users to set.
            yield choice, prefix + field.name, field.metadata["doc"], allowed


def _is_tree(kind: Any) -> bool:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)
