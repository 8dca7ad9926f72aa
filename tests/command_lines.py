"""Command lines in this process, up to the first thing that would be left on disk or started."""

from __future__ import annotations

import errno
import io
import os
import socket
import subprocess
import sys
import tempfile
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from gmijax import demo, doctor
from gmijax.__main__ import main
from gmijax.autotune import tuner
from gmijax.cli.grid import SweepHelp
from gmijax.cli.pack import PackKeys
from gmijax.config import ExportConfig, PlayConfig, ServeConfig, TrainConfig, ViewConfig
from gmijax.control import decide, searching
from gmijax.deploy import exporting, playing, viewing
from gmijax.machine.snapshot import Machine
from gmijax.sweeps import runner

COMMANDS: Mapping[str, tuple[type[Any], ...]] = {
    "train": (TrainConfig,),
    "play": (PlayConfig,),
    "view": (ViewConfig,),
    "serve": (ServeConfig,),
    "search": (TrainConfig,),
    "sweep": (SweepHelp,),
    "pack": (PackKeys,),
    "export": (ExportConfig,),
    "doctor": (),
    "list-envs": (),
    "demo": (TrainConfig,),
}
"""The commands with the configurations whose keys they take."""

CPU = Machine(gpus=(), cpu_cores=(0, 1, 2, 3))
"""A machine without a GPU."""


class Done(NamedTuple):
    """What a command line came to; `code` is None where it would have started something."""

    code: int | None
    stdout: str
    stderr: str


class WouldStart(BaseException):
    """All checks are done; what comes next would start something."""


def run(command: str, *argv: str, cwd: Path, machine: Machine = CPU) -> Done:
    """Runs a command line in `cwd` of a faked machine, with streams like a user's.

    It ends where it would make or start something. Every command makes a folder before it starts
    a process, so that is where. A process that is started all the same is an error.
    """
    out, err = _stream("strict"), _stream("backslashreplace")
    with _nothing_starts(machine, cwd), redirect_stdout(out), redirect_stderr(err):
        try:
            code = main([command, *argv])
        except WouldStart:
            code = None
    return Done(code, _text(out), _text(err))


@contextmanager
def _nothing_starts(machine: Machine, cwd: Path) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(cwd)
        patch.setenv("XDG_CACHE_HOME", str(cwd / "cache"))
        for module in (decide, searching, playing, exporting, runner, demo, doctor):
            patch.setattr(module, "detect_machine", lambda: machine)
        patch.setattr(doctor, "inspect_system", _would_start)
        # A page needs no folder.
        patch.setattr(viewing, "require_packages", _would_start)
        for name in ("ray", "ray.util", "ray.util.scheduling_strategies"):
            patch.setitem(sys.modules, name, _Ray(name))
        patch.setattr(socket, "create_connection", _would_start)
        patch.setattr(Path, "mkdir", _mkdir)
        patch.setattr(tempfile, "mkstemp", _would_start)
        patch.setattr(tuner.Search, "result", _would_start)
        for owner, name in ((subprocess, "Popen"), (os, "fork"), (os, "posix_spawn")):
            patch.setattr(owner, name, _must_not_start)
        yield


def _would_start(*_: Any, **__: Any) -> Any:
    raise WouldStart


class _Ray(types.ModuleType):
    """Ray takes seconds to import, and would start processes of its own."""

    init = staticmethod(_would_start)

    @staticmethod
    def is_initialized() -> bool:
        return False


def _stream(errors: str) -> io.TextIOWrapper:
    return io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors=errors, newline="")


def _text(stream: io.TextIOWrapper) -> str:
    stream.seek(0)
    return stream.read()


def _mkdir(path: Path, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
    """Refuses what a file system would; makes nothing."""
    del mode, parents
    try:
        os.stat(path)
    except FileNotFoundError:
        raise WouldStart from None
    if exist_ok and path.is_dir():
        return
    raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def _must_not_start(*args: Any, **__: Any) -> Any:
    raise AssertionError(f"a process would be started: {args}")
