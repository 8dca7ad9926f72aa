"""The pack that a command line stands for: a grid and keys, `--`, and the command."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from hydra.core.override_parser.types import ChoiceSweep, Override, QuotedString

from gmijax.cli.arguments import parse, quoted, readable
from gmijax.cli.command import command
from gmijax.cli.compose import compose_dict
from gmijax.cli.grid import values_of, without_folder
from gmijax.config import ClusterConfig
from gmijax.config.pack import PackConfig
from gmijax.config.schema import KeyGroup, doc, from_dict, to_dict
from gmijax.control.console import Show
from gmijax.errors import ConfigError
from gmijax.packs.pack import PackWork, pack_of
from gmijax.sweeps.runner import run_work
from gmijax.sweeps.space import Choices, Interval
from gmijax.sweeps.work import Folder

_OWN = ("pack.", "run.", "cluster.")
_TEXTS = tuple(f"pack.{key}" for key in ("commands", "cwd", "steps", "rate", "metric", "resume"))
_MARKS = "'\"[]{}()\\"
"""What Hydra's grammar gives a meaning in values."""


@dataclass(frozen=True, kw_only=True)
class PackRun(KeyGroup):
    """The folder of a pack."""

    prefix = "run."

    dir: str | None = doc("folder of the pack; null: runs/pack-<date>-<time>")
    name: str | None = doc(
        "name of the folder below runs/ (ignored if run.dir is given)", may_be_empty=True
    )


@dataclass(frozen=True, kw_only=True)
class PackKeys:
    """All keys of a pack, as `--help` prints them."""

    run: PackRun
    pack: PackConfig
    cluster: ClusterConfig


def pack_command(argv: Sequence[str]) -> int:
    """Runs `gmijax.pack`; returns its exit code."""
    at = list(argv).index("--") if "--" in argv else len(argv)
    words, program = list(argv[:at]), argv[at + 1 :]
    events = None
    if "--json" in words:
        words.remove("--json")
        events = sys.stdout

    def make(words: Sequence[str]) -> PackWork:
        return build_pack(words, program)

    def run(work: PackWork, *, show: Show) -> None:
        run_work(work, show=show if events is None else False, events=events)

    return command("pack", PackKeys, run, words, make=make, shown=_shown)


def build_pack(words: Sequence[str], program: Sequence[str]) -> PackWork:
    """The pack of a command line, with all that can be checked of it.

    Args:
      words: `key=value`: keys of a pack, or names of the grid with one or several values.
      program: arguments of the command; empty with `pack.commands`.

    Raises:
      ConfigError: bad input.
    """
    for word in words:
        if "=" not in word and shutil.which(word):
            raise ConfigError(f"{word}: expected key=value; a command to run comes after --")
    typed = (*without_folder(words), *(("--", *program) if program else ()))
    words = [_as_text(word) for word in words]
    given = list(zip(words, parse(words), strict=True))
    own = [text for text, item in given if item.key_or_group.startswith(_OWN)]
    for text, item in given:
        if text in own and item.is_sweep_override():
            raise ConfigError(f"{text}: expected one value (a list stands in brackets)")
    keys = from_dict(PackKeys, compose_dict("pack", readable("pack", own)))
    space = {item.key_or_group: _values(item) for text, item in given if text not in own}
    if len(space) < len(given) - len(own):
        raise ConfigError("a name of the grid is repeated")
    folder = Folder(keys.run.dir, keys.run.name)
    return replace(pack_of(keys.pack, space, program, folder, keys.cluster), words=typed)


def _as_text(word: str) -> str:
    """Keys that hold commands, expressions and paths need no quotes of Hydra's."""
    key, equals, value = word.partition("=")
    is_text = key in _TEXTS or key.startswith("pack.env.")
    is_quoted = len(value) > 1 and value[0] == value[-1] and value[0] in "'\""
    is_plain = not value or value == "null" or is_quoted
    if is_text and equals and not is_plain:
        # A shell's variables are the job's, not ours.
        word = f"{key}={quoted(value)}".replace("${", "\\${")
    return f"++{word}" if key.startswith("pack.env.") else word  # Its names are the user's.


def _values(item: Override) -> Choices | Interval:
    """Values as they were typed: `1e-4` stays that, and is not 0.0001."""
    value = item.value()
    is_list = isinstance(value, ChoiceSweep) and value.simple_form
    text = str(item.input_line).partition("=")[2]
    if not text.strip():  # As of a variable that the shell does not have.
        raise ConfigError(f"{item.input_line}: must not be empty")
    if (is_list or not item.is_sweep_override()) and not any(mark in text for mark in _MARKS):
        return Choices(_distinct(item, [part.strip() for part in text.split(",")]))
    if not item.is_sweep_override():
        return Choices((value if isinstance(value, str) else item.get_value_element_as_str(),))
    if isinstance(value, ChoiceSweep):
        shown = zip(value.list, item.sweep_string_iterator(), strict=True)
        return Choices(
            _distinct(item, [v.text if isinstance(v, QuotedString) else text for v, text in shown])
        )
    return values_of(item)


def _distinct(item: Override, values: Sequence[str]) -> tuple[str, ...]:
    if len(set(values)) < len(values):
        raise ConfigError(f"{item.input_line}: a value is repeated")
    return tuple(values)


def _shown(work: PackWork) -> dict[str, Any]:
    """What `--cfg job` prints."""
    commands = [list(job.arguments(work.paths_shown(job.number))) for job in work.jobs]
    return {"pack": to_dict(work.settings), "jobs": commands}
