"""The folder of a sweep: how it is opened, what is left of it, errors of the disk."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gmijax.control.exit_codes import OF_KINDS
from gmijax.errors import ConfigError, FolderLost, SweepFailed
from gmijax.runs.folder import create_run, given_run, holds_something_else
from gmijax.runs.held import is_locked
from gmijax.runs.names import nearby
from gmijax.sweeps.any_job import J
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.work import Work


@contextmanager
def opened_folder(work: Work[J]) -> Iterator[SweepPaths]:
    """The folder of the jobs, made if it is not there; gone again if nothing was begun in it."""
    folder = given_run(*work.folder)
    is_new = folder is None or not os.path.lexists(folder)
    if folder is None or is_new:
        root = create_run(*work.folder, work.name).root
    else:
        root = _found(folder, work)
    paths = work.paths(root)
    is_anothers = is_locked(paths.lock)
    try:
        yield paths
    except FolderLost:
        raise
    except BaseException:
        if not is_anothers and not paths.request.exists():
            with suppress(OSError):
                for path in (paths.study, paths.lock):
                    path.unlink(missing_ok=True)
                if is_new:
                    paths.root.rmdir()
        raise


def _found(folder: Path, work: Work[J]) -> Path:
    if not folder.is_dir():
        raise ConfigError(f"run.dir={folder}: is not a folder")
    paths = work.paths(folder.resolve())
    if holds_something_else(paths.root, own=paths.request, lock=paths.lock):
        raise ConfigError(f"run.dir={folder}: is not a {work.name} folder, and is not empty")
    return paths.root


def require_folders(paths: SweepPaths, numbers: Iterable[int]) -> None:
    """Raises ConfigError where the path of a job's folder is something else."""
    for number in numbers:
        for folder in (paths.run_dir(number), paths.job(number).root, paths.log(number).parent):
            if os.path.lexists(folder) and not folder.is_dir():
                raise ConfigError(f"{nearby(folder)}: is not a folder")


@contextmanager
def errors_of_files(paths: SweepPaths) -> Iterator[None]:
    """Turns an error of a file into one line.

    Raises:
      ConfigError: a path is a folder instead of a file, or a file instead of a folder.
      SweepFailed: anything else, such as a full disk.
    """
    try:
        yield
    except OSError as error:
        text = f"{nearby(Path(error.filename or paths.root))}: {error.strerror or error}"
        raise (ConfigError if error.errno in OF_KINDS else SweepFailed)(text) from error
