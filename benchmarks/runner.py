"""Runs the commands of benchmarks: in turn, in time, several at the same time."""

from __future__ import annotations

import argparse
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, NamedTuple, TypeVar

from benchmarks.records import RESULTS
from gmijax.errors import ConfigError
from gmijax.runs.folder import read_json
from gmijax.supervise.failures import last_line

STOP_S = 15.0
"""Time for a command that has reached its deadline to save and end."""

_ROOT = Path(__file__).resolve().parents[1]

Case = TypeVar("Case", bound=Hashable)


def options(prog: str, about: str | None) -> argparse.ArgumentParser:
    """A parser of `python -m benchmarks.PROG`, with the option that all benchmarks have."""
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{prog}",
        description=about,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    return parser


def exit_code(main: Callable[[], int]) -> int:
    """What `main` returns; 2 and one line on bad input, 130 if SIGINT or SIGTERM ends it."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return main()
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except KeyboardInterrupt:
        return 130


def deadline(seconds: float | None) -> float:
    """So many seconds from now on the clock of `time.monotonic`; None: never."""
    return time.monotonic() + (math.inf if seconds is None else seconds)


def in_turn(
    cases: Sequence[Case],
    repeats: int,
    deadline_s: float = math.inf,
    like: Callable[[Case], Hashable] = lambda case: case,
) -> Iterator[tuple[int, Case]]:
    """The number of the repeat and the case: every case once before any is repeated.

    A case that would not end in time is left out. It is expected to take as long as the longest
    one before that is like it; the time of a case is what passes until the next one is asked for.
    """
    longest_s: dict[Hashable, float] = {}
    for repeat in range(repeats):
        for case in cases:
            started_s, kind = time.monotonic(), like(case)
            if started_s + longest_s.get(kind, 0.0) >= deadline_s - STOP_S:
                continue
            yield repeat, case
            longest_s[kind] = max(longest_s.get(kind, 0.0), time.monotonic() - started_s)


def start(
    command: Sequence[str], variables: Mapping[str, str], output: IO[bytes] | None = None
) -> subprocess.Popen[bytes]:
    """Starts a command.

    Args:
      command: with its arguments.
      variables: of the environment, beside those of this process.
      output: gets its output; None: the output of this process does.
    """
    return subprocess.Popen(
        command,
        env={**os.environ, **variables},
        stdout=output,
        stderr=output,
        start_new_session=True,  # So that it gets Ctrl-C only once.
    )


def wait_until(deadline_s: float, *processes: subprocess.Popen[bytes]) -> list[int]:
    """Waits for processes; asks them to save and end in time, or when this is interrupted.

    Those that do not are killed.

    Args:
      deadline_s: on the clock of `time.monotonic`; they are asked `STOP_S` before.
      processes: that were started.

    Returns:
      Their exit codes, negative for a signal.
    """
    try:
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline_s - STOP_S - time.monotonic()))
    finally:
        running = [process for process in processes if process.poll() is None]
        for process in running:
            process.send_signal(signal.SIGINT)
        killed_s = time.monotonic() + STOP_S
        for process in running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, killed_s - time.monotonic()))
            process.kill()
    return [process.wait() for process in processes]


def run_command(
    command: Sequence[str], deadline_s: float, variables: Mapping[str, str] | None = None
) -> int:
    """Runs one command, see `start` and `wait_until`; returns its exit code."""
    return wait_until(deadline_s, start(command, variables or {}))[0]


class Command(NamedTuple):
    """A command whose output goes to `log` in a folder, with variables of its environment."""

    words: Sequence[str]
    folder: Path
    variables: Mapping[str, str]


def failures_of(commands: Sequence[Command], deadline_s: float) -> list[str | None]:
    """Runs commands at the same time; the last line of those that failed, else None."""
    with ExitStack() as logs:
        processes = [
            start(one.words, one.variables, logs.enter_context((one.folder / "log").open("wb")))
            for one in commands
        ]
        codes = wait_until(deadline_s, *processes)
    return [
        (last_line(one.folder / "log") or f"exit code {code}") if code else None
        for one, code in zip(commands, codes, strict=True)
    ]


def sweep_report(
    words: Sequence[str],
    folder: Path,
    deadline_s: float,
    variables: Mapping[str, str] | None = None,
) -> tuple[int, dict[str, Any]]:
    """Runs a sweep in a folder: its exit code, and its `sweep.json`; ends this if it wrote none.

    Args:
      words: of `gmijax.sweep`.
      folder: of the sweep.
      deadline_s: see `wait_until`.
      variables: of the environment.
    """
    command = [sys.executable, "-m", "gmijax.sweep", *words, f"run.dir={folder}"]
    code = run_command(command, deadline_s, variables)
    report = folder / "sweep.json"
    if not report.exists():
        raise SystemExit(f"no result of a sweep with {' '.join(words)} (exit code {code})")
    return code, read_json(report)


def failure_of(
    command: Sequence[str],
    folder: Path | None = None,
    variables: Mapping[str, str] = MappingProxyType({}),
) -> str | None:
    """Runs a command; the last line that it wrote to stderr if it failed, else None.

    Args:
      command: with its arguments.
      folder: what it works in, with the gmijax of this checkout; None: that of this process.
      variables: of the environment, beside those of this process.
    """
    of_folder = {} if folder is None else own_path()
    done = subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, **of_folder, **variables},
        check=False,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    return lines[-1] if done.returncode else None


def own_path() -> dict[str, str]:
    """The variable by which a process in any folder finds the gmijax of this checkout."""
    path = os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))
    return {"PYTHONPATH": path}


def as_word(text: str) -> str:
    """Letters and digits only: a name of a folder that is a value on a command line."""
    return re.sub(r"[^a-zA-Z0-9]+", "-", text)
