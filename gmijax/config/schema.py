"""Typed trees of plain data: what `gmijax.config` is built with.

`from_dict` makes a tree of frozen dataclasses from plain data (JSON, YAML, a command line) and
rejects unknown keys, wrong types and values out of range with one clear line. No hydra, no jax.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import re
import sys
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

from gmijax.errors import ConfigError, MissingKey

T = TypeVar("T")


def doc(
    text: str,
    default: Any = dataclasses.MISSING,
    *,
    low: float | None = None,
    high: float | None = None,
    positive: bool = False,
    may_be_empty: bool = False,
) -> Any:
    """A dataclass field whose meaning `--help` prints; one with a default may be left out.

    `KeyGroup` checks its limits: at least `low`, at most `high`, or greater than 0. A text is not
    empty, as of a variable that the shell does not have, unless it `may_be_empty`.
    """
    limits = (low, high, positive)
    metadata = {"doc": text, "limits": limits, "may_be_empty": may_be_empty}
    return dataclasses.field(metadata=metadata, default=default)


class KeyGroup:
    """Base of dataclasses whose fields have limits, see `doc`; `prefix` is their keys' group."""

    prefix = ""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(typing.cast("Any", self)):
            limits, found = field.metadata.get("limits"), getattr(self, field.name)
            if isinstance(found, str) and not found.strip() and _must_say_something(field):
                raise ConfigError(f"{self.prefix}{field.name}={found}: must not be empty")
            for value in found if isinstance(found, tuple) else (found,):
                if limits and isinstance(value, int | float):
                    _require_limits(f"{self.prefix}{field.name}", value, *limits)


def _must_say_something(field: dataclasses.Field[Any]) -> bool:
    if field.type == "str | None":  # What has no `doc` no user gives.
        return not field.metadata.get("may_be_empty", True)
    return field.type == "str"


def _require_limits(
    key: str, value: float, low: float | None, high: float | None, positive: bool
) -> None:
    if positive:
        require_positive(key, value)
    if low is not None and high is not None:
        require_between(key, value, low, high)
    elif low is not None:
        require_at_least(key, value, low)


def require_at_least(key: str, value: float, low: float) -> None:
    """Raises ConfigError unless `value >= low`."""
    if not value >= low:
        raise ConfigError(f"{key}={value!r}: must be at least {low}")


def require_positive(key: str, value: float) -> None:
    """Raises ConfigError unless `value > 0`."""
    if not value > 0:
        raise ConfigError(f"{key}={value!r}: must be greater than 0")


def require_between(key: str, value: float, low: float, high: float) -> None:
    """Raises ConfigError unless `low <= value <= high`."""
    if not low <= value <= high:
        raise ConfigError(f"{key}={value!r}: must be between {low} and {high}")


def require_config(config: object, cls: type[Any]) -> None:
    """Raises ConfigError unless `config` is one of `cls`: overrides alone are none."""
    if not isinstance(config, cls):
        raise ConfigError(
            f"config={config!r}: expected a {cls.__name__}; gmijax.compose makes one"
        )


@functools.cache
def _hints(cls: type[Any]) -> dict[str, Any]:
    """Types of the fields; half of the time of a large sweep if they are evaluated each time."""
    return typing.get_type_hints(cls)


def from_dict(cls: type[T], data: Mapping[str, Any], path: str = "") -> T:
    """Builds a frozen config tree from plain data, checking names and types.

    Lists become tuples, and a float with a whole value is accepted for an integer (`30e6`).

    Raises:
      ConfigError: an unknown or missing key, a wrong type, or a value out of range.
    """
    hints = _hints(cls)
    for key in data:
        if key not in hints:
            raise ConfigError(f"unknown key {path}{key}{suggestion(key, hints)}")
    if missing := [key for key in hints if key not in data and not _has_default(cls, key)]:
        raise MissingKey(f"missing key {path}{missing[0]}")
    given = {key: kind for key, kind in hints.items() if key in data}
    return cls(**{key: convert(kind, data[key], path + key) for key, kind in given.items()})


def from_named(classes: Sequence[type[T]], data: Mapping[str, Any], path: str = "") -> T:
    """`from_dict` with the one of `classes` whose field `name`, a literal, allows that of `data`.

    Raises:
      ConfigError: none does, or as `from_dict`.
    """
    return from_dict(_class_of(classes, data, path), data, path)


def _class_of(classes: Sequence[type[T]], data: Mapping[str, Any], path: str) -> type[T]:
    by_name = {name: cls for cls in classes for name in typing.get_args(_hints(cls)["name"])}
    name = data.get("name")
    if not isinstance(name, str) or name not in by_name:
        raise ConfigError(f"{path}name={_shown(name)}: expected one of {', '.join(by_name)}")
    return by_name[name]


def known(
    classes: Sequence[type[Any]], data: Mapping[str, Any], path: str = ""
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Plain data, perhaps of another version, without keys that `from_dict` would not know.

    Args:
      classes: one, or several that differ in their field `name`, see `from_named`.
      data: not changed.
      path: of the group, with a dot at its end.

    Returns:
      What is left, and the dotted names of all that was left out.

    Raises:
      ConfigError: as `from_named`.
    """
    cls = classes[0] if len(classes) == 1 else _class_of(classes, data, path)
    hints = _hints(cls)
    kept: dict[str, Any] = {}
    unknown: tuple[str, ...] = ()
    for key, value in data.items():
        trees = [x for x in _options(hints.get(key)) if dataclasses.is_dataclass(x)]
        if key not in hints:
            unknown += (f"{path}{key}",)
        elif trees and isinstance(value, Mapping):
            kept[key], inner = known(typing.cast("Any", trees), value, f"{path}{key}.")
            unknown += inner
        else:
            kept[key] = value
    return kept, unknown


def to_dict(config: Any) -> dict[str, Any]:
    """The plain data of a config tree; `from_dict` inverts it."""
    return dataclasses.asdict(config)


def flatten(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A tree of mappings as one: values by their dotted names."""
    flat: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def suggestion(key: str, allowed: typing.Iterable[str]) -> str:
    """`: did you mean ...` where a name is close, else `; allowed: ...`."""
    names = sorted(allowed)
    if close := close_name(key, names):
        return f": did you mean {close}?"
    return f"; allowed: {', '.join(names) or 'none'}"


def close_name(word: str, names: typing.Iterable[str]) -> str | None:
    """The one of the names that a word may mean, in capitals or not."""
    of_small = {name.lower(): name for name in names}
    close = difflib.get_close_matches(word.lower(), of_small, n=1)
    return of_small[close[0]] if close else None


def _has_default(cls: Any, key: str) -> bool:
    field = cls.__dataclass_fields__[key]
    return (field.default, field.default_factory) != (dataclasses.MISSING, dataclasses.MISSING)


def convert(kind: Any, value: Any, key: str) -> Any:
    """Plain data as a value of the type `kind`; raises ConfigError if it is none."""
    trees: list[Any] = [x for x in _options(kind) if dataclasses.is_dataclass(x)]
    if trees:
        if not isinstance(value, Mapping):
            raise ConfigError(f"{key}={_shown(value)}: expected a group of keys")
        if len(trees) > 1:
            return from_named(trees, value, f"{key}.")
        return from_dict(trees[0], value, f"{key}.")
    for option in _options(kind):
        converted = _accept(option, value, key)
        if converted is not _REJECTED:
            return converted
    meant = _in_digits(kind, value) + _as_sweep(kind, value, key)
    raise ConfigError(f"{key}={_shown(value)}: expected {_describe(kind)}{meant}")


def _in_digits(kind: Any, value: Any) -> str:
    """`30M` as a number, where one is expected."""
    match = re.fullmatch(r"([\d.]+)([kKmMgGbB])", value) if isinstance(value, str) else None
    if match is None or not {int, float} & set(_options(kind)):
        return ""
    return f"; did you mean {match[1]}e{_POWERS[match[2].lower()]}?"


def _as_sweep(kind: Any, value: Any, key: str) -> str:
    """`0:3` or `0-2` as several values, where one number is expected."""
    text = value if isinstance(value, str) else ""
    match = re.fullmatch(r"(\d{1,12})(:|-|\.\.)(\d{1,12})", text)
    if match is None or not {int, float} & set(_options(kind)) or key.startswith(_ONCE):
        return ""
    first, end = int(match[1]), int(match[3]) + (match[2] != ":")
    if end - first < 2:
        return ""
    few = ",".join(str(number) for number in range(first, min(end, first + 3)))
    more = ",..." if end - first > 3 else ""
    return f"; for several: gmijax sweep {key}={few}{more} or '{key}=range({first},{end})'"


_ONCE = ("run.", "sweep.", "pack.", "cluster.")
"""Beginnings of keys that a sweep has once, and not for each job."""

_POWERS = types.MappingProxyType({"k": 3, "m": 6, "g": 9, "b": 9})

_REJECTED = object()


def _options(kind: Any) -> tuple[Any, ...]:
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return typing.get_args(kind)
    return (kind,)


def _accept(kind: Any, value: Any, key: str) -> Any:
    if typing.get_origin(kind) is not None:
        return _accept_generic(kind, value, key)
    if kind is type(None):
        return None if value is None else _REJECTED
    if isinstance(value, bool):
        return value if kind is bool else _REJECTED
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if kind is float and isinstance(value, int | float):
        # Neither not-a-number nor infinite, nor an integer that is larger than any float.
        return float(value) if abs(value) <= sys.float_info.max else _REJECTED
    if kind is str and isinstance(value, int):
        return str(value)
    return value if isinstance(kind, type) and isinstance(value, kind) else _REJECTED


def _accept_generic(kind: Any, value: Any, key: str) -> Any:
    inner = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        if isinstance(value, bool):  # YAML reads a bare `off` or `on` as a boolean.
            value = "on" if value else "off"
        return value if value in inner else _REJECTED
    if typing.get_origin(kind) is Mapping and isinstance(value, Mapping):
        return {
            str(name): convert(inner[1], item, f"{key}.{name}") for name, item in value.items()
        }
    if typing.get_origin(kind) is tuple and isinstance(value, list | tuple):
        return tuple(convert(inner[0], item, key) for item in value)
    return _REJECTED


def _describe(kind: Any) -> str:
    names = {int: "an integer", float: "a finite number", bool: "true or false", str: "text"}
    parts: list[str] = []
    for option in _options(kind):
        if typing.get_origin(option) is Literal:
            allowed = [str(value) for value in typing.get_args(option)]
            parts.append(allowed[0] if len(allowed) == 1 else f"one of {', '.join(allowed)}")
        elif typing.get_origin(option) is tuple:
            inner = typing.get_args(option)[0]
            nested = typing.get_origin(inner) is tuple
            if typing.get_origin(inner) is Literal:
                parts.append(f"a list of {', '.join(map(str, typing.get_args(inner)))}")
                continue
            items = {float: "numbers", str: "names"}.get(inner, "integers")
            parts.append("a list of lists of integers" if nested else f"a list of {items}")
        elif typing.get_origin(option) is Mapping:
            parts.append("a group of keys")
        elif option is type(None):
            parts.append("null")
        else:
            parts.append(names[option])
    return " or ".join(parts)


def _shown(value: Any) -> str:
    """As plain data has it: `null` and `true`, which Python calls otherwise."""
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    return str(value) if isinstance(value, str) else repr(value)
