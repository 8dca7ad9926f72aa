"""Keys of a configuration as they are typed on a command line."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import typing
from typing import Any

from gmijax.config.schema import KeyGroup

_PLAIN = re.compile(r"[A-Za-z][\w.:/-]*", re.ASCII)
"""Text that a command line takes as it is."""

_NO_TEXT = ("null", "true", "false", "on", "off", "yes", "no", "nan", "inf")
"""Words that it takes for something else than text."""


def typed(group: KeyGroup) -> list[str]:
    """`key=value`, quoted for a shell, of every key whose value is not its default.

    Keys without a default in the dataclass are left out.
    """
    fields = dataclasses.fields(typing.cast("Any", group))
    values = [(field, getattr(group, field.name)) for field in fields]
    return [
        shlex.quote(f"{group.prefix}{field.name}={_value(value)}")
        for field, value in values
        if field.default is not dataclasses.MISSING and value != field.default
    ]


def _value(value: object) -> str:
    is_plain = isinstance(value, str) and _PLAIN.fullmatch(value)
    if is_plain and str(value).lower() not in _NO_TEXT:
        return str(value)
    # Lists, numbers and null are written as in JSON, but for the blanks.
    return json.dumps(value, separators=(",", ":"))
