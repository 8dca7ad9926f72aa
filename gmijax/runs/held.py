"""Folders that a job writes into: held by a lock, and noticed if they are no longer there."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from gmijax.errors import BackendUnavailable, ConfigError, FolderLost, JobInterrupted
from gmijax.runs.names import nearby

_GONE: Final = (errno.ENOENT, errno.ENOTDIR, errno.ESTALE)
"""Errors of a path that leads nowhere; others, of a network for one, do not show that."""


class OpenFolder:
    """A folder as it is now, to be compared with what its path leads to later.

    Args:
      root: its path.
      what: how messages name it.

    Raises:
      OSError: there is no such folder.
    """

    def __init__(self, root: Path, what: str) -> None:
        self._root, self._what = root, what
        # Open, so that no other folder can get its number.
        self._fd = os.open(root, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)

    def __enter__(self) -> OpenFolder:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._fd)

    def is_there(self) -> bool:
        """Whether its path still leads to it."""
        try:
            return os.path.samestat(os.stat(self._root), os.fstat(self._fd))
        except OSError as error:
            return error.errno not in _GONE

    def require(self) -> None:
        """Raises FolderLost, with its present path, if its path does not lead to it."""
        if self.is_there():
            return
        now = self._now()
        where = "was removed or replaced" if now is None else f"was moved to {nearby(now)}"
        use = "" if now is None else "; what it has can be used there"
        raise FolderLost(f"{self._what}: the folder {where} while a job wrote into it{use}")

    def _now(self) -> Path | None:
        """Where it is; None: nowhere."""
        try:
            path = Path(os.readlink(f"/proc/self/fd/{self._fd}"))
            is_it = os.path.samestat(path.stat(), os.fstat(self._fd))
        except OSError:
            return None
        return path if is_it else None


@contextmanager
def locked(lock: Path, what: str) -> Iterator[OpenFolder]:
    """Holds a folder by a file in it, so that two jobs cannot write into it at once.

    Raises:
      ConfigError: another job holds it, or it cannot be locked.
    """
    try:
        fd = try_lock(lock)
    except OSError as error:
        raise ConfigError(f"{what}: cannot be locked ({error.strerror})") from None
    if fd is None:
        raise ConfigError(f"{what}: another job writes into this folder now")
    try:
        with OpenFolder(lock.parent, what) as folder:
            yield folder
    finally:
        os.close(fd)


@contextmanager
def gone_if_unused(
    root: Path,
    is_empty: Callable[[], bool],
    remove: Callable[[Path], None] = lambda root: shutil.rmtree(root, ignore_errors=True),
) -> Iterator[None]:
    """Removes a folder that a job made, if it is refused or interrupted before it holds anything.

    A backend that cannot be had is no such input: its logs, which the error names, stay.

    Args:
      root: the folder.
      is_empty: whether it holds nothing yet.
      remove: removes it, or what the job has written there.
    """
    try:
        yield
    except (ConfigError, JobInterrupted) as error:
        if not isinstance(error, BackendUnavailable) and is_empty():
            remove(root)
        raise


def try_lock(lock: Path) -> int | None:
    """A descriptor that holds a lock until it is closed; None: another process holds it.

    Raises:
      OSError: it cannot be locked.
    """
    # A file: network file systems lock no folders, and files only if they are open for writing.
    fd = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, 0o644)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(fd)
        if isinstance(error, BlockingIOError):
            return None
        raise
    return fd


def is_locked(lock: Path) -> bool:
    """Whether a job holds a folder, see `locked`."""
    if not lock.exists():
        return False
    try:
        fd = try_lock(lock)
    except OSError:
        return False  # A command that needs the folder gets the reason later.
    if fd is not None:
        os.close(fd)
    return fd is None
