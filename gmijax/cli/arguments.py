"""Arguments `key=value` as hydra reads them; what it cannot read, in one line."""

from __future__ import annotations

import difflib
import os
import re
import shlex
import unicodedata
from collections.abc import Sequence
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException

from gmijax.cli.groups import choices
from gmijax.config.schema import close_name
from gmijax.errors import ConfigError
from gmijax.runs.folder import RUNS, RunPaths

_MOST_VALUES = 2000
"""In one argument."""

_NOT_TEXT = ("Cc", "Cs", "Zl", "Zp")
"""Unicode's categories of control characters, surrogates, and ends of lines and paragraphs."""


def readable(name: str, overrides: Sequence[str]) -> list[str]:
    """The overrides of a command in words that hydra knows."""
    return [part for text in overrides for part in _with_custom_task(name, _at_home(text))]


def _at_home(override: str) -> str:
    """`key=~/x` with the home folder: a shell writes it only where a word begins with `~`."""
    match = re.fullmatch(r"([^=]+)=(['\"]?)(~[^'\"]*)\2", override)
    if match is None:
        return override
    path = os.path.expanduser(match[3])
    return override if path == match[3] else f"{match[1]}={quoted(path)}"


def _with_custom_task(name: str, override: str) -> tuple[str, ...]:
    """`env=path/to/file.py:make` for hydra; anything else as it is."""
    match = re.fullmatch(r"env=(['\"]?)(.*\.py(:.*)?)\1", override)
    if match is None:
        # Such a task has no run, and no file.
        is_shipped = name in ("play", "view") and override.startswith("env=")
        return (f"run.{override}" if is_shipped else override,)
    value = override.removeprefix("env=") if match[1] else quoted(match[2])
    if name in ("play", "export", "view"):  # The task is that of the run.
        return (f"run.env={value}",)
    return "env=custom", f"env.name={value}"


def quoted(value: str) -> str:
    """A value that hydra takes as text, whatever is in it."""
    return QuotedString(value, Quote.single).with_quotes()


def parse(overrides: Sequence[str]) -> list[Override]:
    """Overrides by Hydra's grammar; raises ConfigError."""
    _require_joined(overrides)
    return [_parsed(text) for text in overrides]


def _require_joined(words: Sequence[str]) -> None:
    """Refuses blanks around `=`; without quotes a shell makes two or three words of that."""
    for at, word in enumerate(words):
        key, equals, value = word.partition("=")
        parts = [word]
        if equals and not key and at and "=" not in words[at - 1]:
            key, parts = words[at - 1], [words[at - 1], *parts]
        if equals and not value and "=" not in (after := "".join(words[at + 1 : at + 2])):
            value, parts = after.removeprefix("~"), [*parts, after]
        is_apart = len(parts) > 1 or key != key.rstrip()
        if is_apart and key and value.strip():
            joined = f"{key.rstrip()}={value.strip()}"
            raise ConfigError(f"{' '.join(parts)}: remove the space: {joined}")


def require_text(text: str) -> None:
    """Raises ConfigError for control characters."""
    # A surrogate stands for a byte that is no text, which nothing can print.
    if any(unicodedata.category(letter) in _NOT_TEXT for letter in text):
        raise ConfigError(f"{text!r}: expected text without control characters")


def _parsed(text: str) -> Override:
    require_text(text)
    if text.count(",") >= _MOST_VALUES:  # Hydra takes the square of their number.
        raise ConfigError(
            f"{text.partition('=')[0]}: {text.count(',') + 1} values; at most {_MOST_VALUES} are "
            "allowed"
        )
    try:
        return OverridesParser.create().parse_overrides([text])[0]
    except RecursionError:
        raise ConfigError(f"{text}: nested too deeply") from None
    except ValueError:  # Python's own limit.
        raise ConfigError(f"{text}: a number has too many digits") from None
    except HydraException as error:
        if "=" not in text:
            raise ConfigError(f"{text}: expected key=value{_meant(text)}") from None
        raise _unreadable(text, error) from None


def _meant(word: str) -> str:
    """The key that a word alone, e.g. `ant`, may be a value of."""
    if re.search(r"\.py(:|$)", word):
        return f"; did you mean env={word}?"
    if word == "last" or "/" in word or os.path.isfile(RunPaths(Path(word)).config):
        return f"; did you mean run.dir={word}?"
    if difflib.get_close_matches(word, ("help",), cutoff=0.7):
        return "; did you mean --help?"
    groups = {name: group for group in ("env", "algo") for name in choices(group)}
    if word not in (*groups, ".", "..") and os.path.isdir(RUNS / word):
        return f"; did you mean run.dir={RUNS / word}?"
    close = close_name(word, groups)
    return f"; did you mean {groups[close]}={close}?" if close else ""


def _unreadable(text: str, error: HydraException) -> ConfigError:
    """Hydra's own messages name rules of its grammar, and often not even the argument."""
    key, _, value = text.partition("=")
    if not value or not re.fullmatch(r"[\w.+~/@:$-]+", key, re.ASCII):
        return ConfigError(f"{text}: expected key=value")
    if not all(key.lstrip("+~").split("@")[0].split(".")):
        return ConfigError(f"{text}: a name is missing before or after a dot of the key")
    if function := re.search(r"while evaluating .*", str(error)):
        return ConfigError(f"{text}: {function[0]}")
    if unclosed := re.fullmatch(r"""(['"])[^'"]+|[^'"]+(['"])""", value):
        closed = _for_shell(f"{key}={quoted(value.strip(unclosed[1] or unclosed[2]))}")
        return ConfigError(f"{text}: a quote is missing; text in quotes: {closed}")
    shell = _for_shell(f"{key}={quoted(value)}")
    return ConfigError(f"{text}: not a value; text with such characters needs quotes: {shell}")


def _for_shell(word: str) -> str:
    """A word as people would type it; `shlex.quote` takes its single quotes to pieces."""
    if set(word) & set("$`!"):  # A shell reads these within double quotes.
        return shlex.quote(word)
    return '"' + re.sub(r'("|\\(?=["\\]))', r"\\\1", word) + '"'
