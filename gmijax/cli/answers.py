"""What may come next on a command line: values of keys, run folders, checkpoints, options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from gmijax.cli.grid import SweepHelp
from gmijax.cli.help import allowed_values, topics_of
from gmijax.cli.pack import PackKeys
from gmijax.config import ExportConfig, PlayConfig, ServeConfig, TrainConfig, ViewConfig
from gmijax.errors import GmijaxError
from gmijax.runs.checkpoints import checkpoints_of
from gmijax.runs.folder import RUNS
from gmijax.runs.resume import find_checkpoint

COMMANDS: Final[Mapping[str, type[Any]]] = {
    "train": TrainConfig,
    "search": TrainConfig,
    "serve": ServeConfig,
    "sweep": SweepHelp,
    "pack": PackKeys,
    "play": PlayConfig,
    "view": ViewConfig,
    "export": ExportConfig,
}
"""The commands that take keys, and the dataclass of each."""

_OPTIONS: Final = ("--help", "--verbose", "--cfg")
_MOST_RUNS: Final = 30


def own_answers(command: str, words: Sequence[str]) -> list[str] | None:
    """What the last of the words may become; None: Hydra's answer.

    Args:
      command: one with keys.
      words: those after it; the last one may be empty.
    """
    *before, word = words or [""]
    if before and before[-1] in ("--help", "-h"):
        found = topics_of(COMMANDS[command])
    elif before and before[-1] == "--cfg":
        found = ["job"]
    elif word.startswith("-"):
        found = list(_OPTIONS)
    else:
        key, equals, _ = word.partition("=")
        values = _values(command, key, before) if equals else []
        if not values:
            return None
        found = [f"{key}={value}" for value in values]
    return [text for text in found if text.startswith(word)] or None


def _values(command: str, key: str, before: Sequence[str]) -> list[str]:
    if key == "run.resume" and command in ("train", "sweep"):
        return ["last", "auto", *_runs()]
    if key == "run.dir" and command in ("play", "view", "export", "serve"):
        return ["last", *_runs()]
    if key == "checkpoint" and command in ("play", "view", "export"):
        shipped = [] if command == "export" else ["shipped"]
        return ["best", *shipped, *_checkpoints(before)]
    return allowed_values(COMMANDS[command], key)


def _runs() -> list[str]:
    """Folders of runs below the working directory, the newest first, that need no quotes."""
    found: list[tuple[float, str]] = []
    with suppress(OSError):
        for folder in RUNS.iterdir():
            with suppress(OSError):
                found.append(((folder / "config.json").stat().st_mtime, str(folder)))
    return [name for _, name in sorted(found, reverse=True) if name.split() == [name]][:_MOST_RUNS]


def _checkpoints(before: Sequence[str]) -> list[str]:
    """Environment steps of the checkpoints of the run that the line names, or of the last one."""
    runs = [text.removeprefix("run.dir=") for text in before if text.startswith("run.dir=")]
    with suppress(GmijaxError, OSError):
        run = find_checkpoint(runs[-1] if runs else "last", "run.dir").parents[1]
        return [str(int(Path(path).name)) for path in checkpoints_of(run)]
    return []
