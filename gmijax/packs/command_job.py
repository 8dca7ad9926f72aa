"""A command as a job: its arguments, and what its placeholders stand for."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gmijax.config.pack import PackConfig
from gmijax.errors import ConfigError
from gmijax.packs.template import fill, require_names
from gmijax.sweeps.kind import label_of
from gmijax.sweeps.paths import DIGITS
from gmijax.sweeps.progress import Progress


@dataclass(frozen=True)
class CommandJob:
    """One job of a pack.

    Attributes:
      number: from 0.
      overrides: its values of the grid, as they were typed.
      command: arguments, with placeholders.
      total_steps: steps at its end (`pack.total_steps`); None: its output may have them.
      title: what it is called in tables where it has no values.
      progress: how far it is.
    """

    number: int
    overrides: Mapping[str, str]
    command: tuple[str, ...]
    total_steps: int | None = None
    title: str = ""
    progress: Progress = field(default_factory=Progress)

    num_gpus = 1

    @property
    def label(self) -> str:
        """What it is called in tables."""
        return label_of(self.overrides) or self.title

    @property
    def program(self) -> str:
        """The same for jobs that compile the same: the command up to its first option."""
        words = [os.path.abspath(shutil.which(self.command[0]) or self.command[0])]
        for word in self.command[1:]:
            if word.startswith("-") or "{" in word:
                break
            words.append(word)
        return shlex.join(words)

    @property
    def num_timesteps(self) -> int | None:
        """Steps at its end; None: not known."""
        return self.total_steps or self.progress.num_timesteps

    def values(self, run_dir: Path) -> dict[str, str]:
        """What its placeholders stand for."""
        return {**self.overrides, "job": f"{self.number:0{DIGITS}d}", "run_dir": str(run_dir)}

    def arguments(self, run_dir: Path, more: Sequence[str] = ()) -> tuple[str, ...]:
        """The command in a folder, with more words that may hold placeholders."""
        return tuple(fill([*self.command, *more], self.values(run_dir)))


def jobs_of_file(settings: PackConfig) -> tuple[CommandJob, ...]:
    """A job for every line of `pack.commands`; `#` begins a comment.

    Raises:
      ConfigError: the file cannot be read, or a line of it.
    """
    path = str(settings.commands)
    try:
        text = sys.stdin.read() if path == "-" else Path(path).expanduser().read_text()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "is no text"
        raise ConfigError(f"pack.commands={path}: cannot be read ({why})") from None
    jobs: list[CommandJob] = []
    for number, line in enumerate(text.splitlines(), 1):
        try:
            words = shlex.split(line, comments=True)
            require_names([*words, *templates_of(settings)], ())
        except (ValueError, ConfigError) as error:
            raise ConfigError(f"pack.commands={path}: line {number}: {error}") from None
        if words:
            title = shlex.join(words)
            jobs.append(CommandJob(len(jobs), {}, tuple(words), settings.total_steps, title))
    if not jobs:
        raise ConfigError(f"pack.commands={path}: holds no command")
    return tuple(jobs)


def templates_of(settings: PackConfig) -> list[str]:
    """Settings that may hold placeholders."""
    given = [text for text in (settings.resume, settings.cwd) if text is not None]
    return [*given, *map(str, settings.env.values())]


def require_programs(jobs: Sequence[CommandJob], settings: PackConfig) -> None:
    """Refuses commands whose program is not there.

    Raises:
      ConfigError: names the program.
    """
    own_path = settings.env.get("PATH")
    for name in dict.fromkeys(job.command[0] for job in jobs):
        # With a working folder of its own a job may find another file there.
        is_elsewhere = settings.cwd is not None and os.sep in name and not os.path.isabs(name)
        if "{" in name or is_elsewhere:
            continue
        if shutil.which(name, path=None if own_path is None else str(own_path)) is None:
            raise ConfigError(f"{name}: no such program, or it cannot be executed")
