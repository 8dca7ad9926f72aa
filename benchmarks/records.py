"""Files of results: one writer and one reader for all benchmarks.

A file holds calls. A call is one command on one machine, with the code and the machine that it was
made with, and the suite's own results. Another call is added to the file; nothing is overwritten.
"""

from __future__ import annotations

import argparse
import os
import platform
import shlex
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from gmijax.control.system_info import REQUIRED
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import detect_machine
from gmijax.runs.folder import read_json, write_json
from gmijax.version import versions_of

RESULTS = Path(__file__).parent / "results"
FORMAT = 2
CPU = "cpu"
"""The device where there is no GPU."""

COMMIT_VARIABLE = "GMIJAX_COMMIT"
"""The commit, where the code is a copy without `.git`: `git describe --always --dirty`."""

_ROOT = Path(__file__).parents[1]
_MEASURED = ("gmijax", "configs", "benchmarks", ":!benchmarks/results")
_OPTIONAL = ("warp-lang", "nccl4py", "cuda-bindings", "optuna", "brax", "playground")
_VERSIONS = ("python", *REQUIRED, *_OPTIONAL)
_SAME = ("commit", "is_dirty", "host", "device", "driver", "versions")
"""What must be equal for a call to be gone on with."""


class Call(NamedTuple):
    """One command on one machine; what a file does not have is None.

    Attributes:
      commit: of the code.
      is_dirty: whether files differed from that commit.
      date: when it began, ISO 8601.
      host: name, cores and system of the machine.
      device: its GPUs, or `cpu`.
      driver: version of NVIDIA's driver.
      versions: of packages.
      command: as it was typed.
      settings: all of its options, defaults too.
      results: what it measured; every suite has a form of its own.
    """

    commit: str | None = None
    is_dirty: bool | None = None
    date: str | None = None
    host: Any = None
    device: str | None = None
    driver: str | None = None
    versions: Mapping[str, str | None] | None = None
    command: str | None = None
    settings: Mapping[str, Any] | None = None
    results: Any = None


class ResultsFile:
    """The results of a running call, in memory and on disk.

    Attributes:
      path: the file; it has the call after the first change.
      suite: what is measured.
      results: of this call.

    Args:
      path: the file.
      suite: what is measured.
      settings: all options of the command.
      resume: go on with the last call of the file, and do not add one.
      device: what is measured on, if not all GPUs of the machine.

    Raises:
      ConfigError: `resume`, and the last call was on other code or another machine.
    """

    def __init__(
        self,
        path: Path,
        suite: str,
        settings: Mapping[str, Any],
        *,
        resume: bool = False,
        device: str | None = None,
    ) -> None:
        self.path, self.suite = path, suite
        self._lock = threading.Lock()
        self._call = _begin(settings, device)
        if resume and path.exists():
            last = read_calls(path)[-1]
            if other := [key for key in _SAME if getattr(last, key) != getattr(self._call, key)]:
                raise ConfigError(f"{path}: its last call has another {other[0]}: begin a new one")
            self._call = last
        self.results: dict[str, Any] = self._call.results

    @contextmanager
    def changing(self) -> Iterator[dict[str, Any]]:
        """Lets one thread at a time change `results`, then writes the file."""
        with self._lock:
            yield self.results
            _add(self.path, self.suite, [self._call])

    def add(self, key: str, row: Mapping[str, Any], **more: Any) -> None:
        """Adds a row to one of the lists in `results`, and what else is known by then."""
        with self.changing() as results:
            results.setdefault(key, []).append(row)
            results.update(more)


def results_file(
    given: argparse.Namespace, suite: str, of: str = "", *, gpus: int | None = None
) -> ResultsFile:
    """The file of a benchmark here, e.g. `seeds-ant-nvidia-h200.json` with `of="-ant"`.

    `gpus` are those that each of its rows is of, however many work at the same time; None: all.
    """
    name = device_name()
    device = None if gpus is None or name == CPU else f"{gpus} x {name}"
    return ResultsFile(
        given.out / file_name(f"{suite}{of}", name), suite, vars(given), device=device
    )


def read_calls(path: Path) -> list[Call]:
    """The calls in a file, oldest first.

    Raises:
      ConfigError: there is no such file, or it has another format.
    """
    if not path.exists():
        raise ConfigError(f"{path}: no such file of results")
    found = read_json(path)
    if found.get("format") != FORMAT:
        raise ConfigError(f"{path}: format={found.get('format')}: expected {FORMAT}")
    return [Call(**call) for call in found["calls"]]


def add_calls(files: Sequence[Path], results: Path = RESULTS) -> None:
    """Adds the calls in files of another machine to the files of results of their names.

    Raises:
      ConfigError: there is no such file.
    """
    for file in files:
        calls = read_calls(file)
        _add(results / file.name, read_json(file).get("suite", file.stem), calls)


def _add(path: Path, suite: str, added: Sequence[Call]) -> None:
    """Writes calls behind those that a file has by now; one that it has already is changed."""
    dates = {call.date for call in added}
    found = read_calls(path) if path.exists() else []
    calls = [*(call for call in found if call.date not in dates), *added]
    data = {"format": FORMAT, "suite": suite}
    write_json(path, {**data, "calls": [call._asdict() for call in calls]})


def calls_by_date(pattern: str) -> list[tuple[Call, Path]]:
    """The calls in all files of results that match, with their files, oldest first.

    Those without a date are older than all others.
    """
    found = [(call, path) for path in sorted(RESULTS.glob(pattern)) for call in read_calls(path)]
    return sorted(found, key=lambda one: one[0].date or "")


def file_name(suite: str, device: str) -> str:
    """`serving-nvidia-h200.json`."""
    return f"{suite}-{device.replace(' ', '-').lower()}.json"


def device_name() -> str:
    """The first GPU that a job may use here, or `CPU`."""
    gpus = detect_machine().gpus
    return gpus[0].name if gpus else CPU


def _begin(settings: Mapping[str, Any], device: str | None) -> Call:
    machine = detect_machine()
    commit, is_dirty = code_version()
    counts = Counter(gpu.name for gpu in machine.gpus)
    return Call(
        commit=commit,
        is_dirty=is_dirty,
        date=datetime.now().astimezone().isoformat(timespec="microseconds"),
        host=f"{platform.node()}, {os.cpu_count()} cores, {platform.platform()}",
        device=device or ", ".join(f"{n} x {name}" for name, n in counts.items()) or CPU,
        driver=machine.driver_version,
        versions=versions_of(_VERSIONS),
        command=shlex.join(["python", *sys.orig_argv[1:]]),
        settings={key: _plain(value) for key, value in settings.items()},
        results={},
    )


def code_version() -> tuple[str | None, bool | None]:
    """The commit of the checkout, and whether what can change a result differs from it."""
    if given := os.environ.get(COMMIT_VARIABLE):
        return given.removesuffix("-dirty"), given.endswith("-dirty")
    commit = _git("rev-parse", "HEAD")
    changed = _git("status", "--porcelain", "--", *_MEASURED)
    return commit or None, None if changed is None else bool(changed)


def _git(*words: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", *words], cwd=_ROOT, capture_output=True, text=True, check=False
        )
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _plain(value: Any) -> Any:
    """What JSON gives back as it was."""
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(one) for one in value]
    return value
