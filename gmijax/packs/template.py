"""Placeholders in the command of a pack: `{seed}` stands for the value that a job has of `seed`.

The command is a list of arguments, which no shell reads. Braces that are no placeholder stay as
they are: JSON and `${VARIABLE}` pass unharmed. `{{` and `}}` stand for single braces.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

from gmijax.config.schema import suggestion
from gmijax.errors import ConfigError

OWN_NAMES: Final = ("job", "run_dir")
"""Placeholders that every job has: its number (three digits or more), and its folder."""

_PARTS: Final = re.compile(r"\{\{|\}\}|(?<!\$)\{([A-Za-z_][\w.]*)\}")


def placeholders(arguments: Sequence[str]) -> list[str]:
    """Names of all placeholders, each once, in order."""
    found = (match[1] for text in arguments for match in _PARTS.finditer(text) if match[1])
    return list(dict.fromkeys(found))


def fill(arguments: Sequence[str], values: Mapping[str, str]) -> list[str]:
    """The arguments with a value for every placeholder.

    Raises:
      KeyError: a placeholder has no value; `require_names` finds it before anything is started.
    """
    return [_filled(text, values) for text in arguments]


def _filled(text: str, values: Mapping[str, str]) -> str:
    num_open = 0

    def value_of(match: re.Match[str]) -> str:
        nonlocal num_open
        if match[1]:
            return values[match[1]]
        # Braces that close what no doubled ones have opened are those of JSON.
        is_opening = match[0] == "{{"
        if not is_opening and not num_open:
            return match[0]
        num_open += 1 if is_opening else -1
        return match[0][0]

    return _PARTS.sub(value_of, text)


def require_names(arguments: Sequence[str], names: Mapping[str, str]) -> None:
    """Refuses placeholders that nothing fills, and names of the grid that no placeholder uses.

    Args:
      arguments: all that may hold placeholders.
      names: of the grid, with their values as they are shown.

    Raises:
      ConfigError: names the first.
    """
    found = placeholders(arguments)
    for name, values in names.items():
        if name in OWN_NAMES:
            raise ConfigError(
                f"{name}={values}: every job has {{{name}}} of its own; give another name"
            )
        if name not in found:
            others = ", ".join(f"{{{other}}}" for other in found)
            only = f" (it has {others})" if others else ""
            raise ConfigError(
                f"{name}={values}: the command has no {{{name}}}{only}, so all jobs would be equal"
            )
    for name in found:
        if name not in names and name not in OWN_NAMES:
            allowed = (*names, *OWN_NAMES)
            raise ConfigError(
                f"{{{name}}}: no such placeholder{suggestion(name, allowed)} "
                f"({{{{{name}}}}} stands for the text {{{name}}})"
            )
