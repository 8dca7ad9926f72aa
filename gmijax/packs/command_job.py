"""A command as a job: its arguments, and what its placeholders stand for."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from gmijax.config.pack import PackConfig
from gmijax.errors import ConfigError
from gmijax.packs.template import fill, require_names
from gmijax.runs.folder import why_no_folder
from gmijax.runs.names import as_typed
from gmijax.sweeps.any_job import label_of
from gmijax.sweeps.paths import DIGITS
from gmijax.sweeps.progress import Progress
from gmijax.sweeps.space import MAX_JOBS


@dataclass(frozen=True)
class CommandJob:
    """One job of a pack.

    Attributes:
      number: from 0.
      overrides: its values of the grid, as they were typed; of a line of a file the line.
      command: arguments, with placeholders.
      total_steps: steps at its end (`pack.total_steps`); None: its output may have them.
      progress: how far it is.
      line: its number in the file of commands; None: it is from no file.
    """

    number: int
    overrides: Mapping[str, str]
    command: tuple[str, ...]
    total_steps: int | None = None
    progress: Progress = field(default_factory=Progress)
    line: int | None = None

    num_gpus = 1

    @property
    def label(self) -> str:
        """What it is called in tables."""
        return label_of(self.overrides)

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

    def folder(self, run_dir: Path, cwd: str) -> str:
        """Its working folder by `pack.cwd`."""
        return fill([cwd], self.values(run_dir))[0]

    def arguments(self, run_dir: Path, more: Sequence[str] = ()) -> tuple[str, ...]:
        """The command in a folder, with more words that may hold placeholders."""
        return tuple(fill([*self.command, *more], self.values(run_dir)))


def jobs_of_file(settings: PackConfig) -> tuple[CommandJob, ...]:
    """A job for every line of `pack.commands`; `#` begins a comment.

    Raises:
      ConfigError: the file cannot be read, or a line of it, or it has too many.
    """
    path = str(settings.commands)
    jobs: list[CommandJob] = []
    for number, line in enumerate(_lines_of(path), 1):
        try:
            words = shlex.split(line, comments=True)
            require_names([*words, *templates_of(settings)], {})
        except (ValueError, ConfigError) as error:
            raise ConfigError(f"pack.commands={path}: line {number}: {error}") from None
        if words and len(jobs) == MAX_JOBS:
            raise ConfigError(
                f"pack.commands={path}: line {number}: at most {MAX_JOBS:,} jobs are allowed"
            )
        if words:
            name = {"command": shlex.join(words)}
            words[0] = absolute(words[0])
            job = CommandJob(len(jobs), name, tuple(words), settings.total_steps, line=number)
            jobs.append(job)
    if not jobs:
        raise ConfigError(f"pack.commands={path}: holds no command")
    return tuple(jobs)


def _lines_of(path: str) -> Iterator[str]:
    """The lines of a file one by one: the standard input may have no end."""
    try:
        with nullcontext(sys.stdin) if path == "-" else Path(path).expanduser().open() as file:
            yield from file
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "is not text"
        raise ConfigError(f"pack.commands={path}: cannot be read ({why})") from None


def templates_of(settings: PackConfig) -> list[str]:
    """Settings that may hold placeholders."""
    given = [text for text in (settings.resume, settings.cwd) if text is not None]
    return [*given, *map(str, settings.env.values())]


def absolute(program: str) -> str:
    """The program of a command for any working folder: a relative path is one from here."""
    is_relative = os.sep in program and not program.startswith(("/", "{", "~"))
    return os.path.abspath(program) if is_relative else program


def require_programs(jobs: Sequence[CommandJob], settings: PackConfig) -> None:
    """Refuses jobs whose program or working folder is not there.

    Raises:
      ConfigError: names it.
    """
    path = settings.env.get("PATH")
    first: dict[str, CommandJob] = {}
    for job in jobs:
        first.setdefault(job.arguments(Path("{run_dir}"))[0], job)
    for name, job in first.items():
        if "{run_dir}" in name:
            continue
        if shutil.which(name, path=None if path is None else str(path)) is None:
            file = f"pack.commands={settings.commands}: line {job.line}: "
            raise ConfigError(
                f"{'' if job.line is None else file}{as_typed(name)}: no such program, or it "
                "cannot be executed"
            )
    if settings.cwd is None:
        return
    for folder in dict.fromkeys(job.folder(Path("{run_dir}"), settings.cwd) for job in jobs):
        if not folder.startswith("{run_dir}") and not os.path.isdir(folder):
            raise ConfigError(f"pack.cwd={folder}: {why_no_folder(folder)}")
