"""The cache folder: compiled programs, profiles and measurements."""

from __future__ import annotations

import os
import re
import stat
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from gmijax.errors import ConfigError

_BROKEN = re.compile(r"Error reading persistent compilation cache entry for '([\w.<>-]+)'")
"""The warning of JAX; it names the program, not the file."""

_ADVICE = "set XDG_CACHE_HOME to a folder of your own"


def cache_folder() -> Path:
    """The user's cache folder of gmijax; it may not exist yet.

    `XDG_CACHE_HOME`, else `~/.cache`. Where there is neither (a container that runs under a number
    which no user has) or it cannot be written, a temporary folder that is this user's alone.

    Raises:
      ConfigError: there is none, and a temporary one cannot be had.
    """
    return _of_user() or _temporary()


def compilation_cache_dir() -> Path:
    """Where compiled programs stay between runs, unless JAX_COMPILATION_CACHE_DIR is set."""
    return cache_folder() / "xla"


def drop_broken_programs(cache: Path, logs: Iterable[Path]) -> None:
    """Removes entries of programs that GMIs could not read, so that the next job writes them.

    JAX writes an entry under its final name, and never over one that is there: a process that is
    killed meanwhile, or a full disk, leaves half an entry for every later job. `logs` are what
    GMIs wrote to stderr. Good entries of these programs are removed too.
    """
    names: set[str] = set()
    for log in logs:
        with suppress(OSError):
            names.update(_BROKEN.findall(log.read_text(errors="replace")))
    for name in names:
        for entry in cache.glob(f"{name}-*"):
            with suppress(OSError):
                entry.unlink()


def why_temporary() -> str | None:
    """A warning that the cache is a temporary folder, None where it is the user's."""
    if _of_user() is not None:
        return None
    return (
        f"warning: no home folder that can be written, so compiled programs and profiles are kept "
        f"in {_temporary()}; set XDG_CACHE_HOME to keep them elsewhere"
    )


def _of_user() -> Path | None:
    named = os.environ.get("XDG_CACHE_HOME")
    if named:
        return Path(named) / "gmijax"
    try:
        home = Path.home()
    except RuntimeError:  # No HOME, and no user with this process's number.
        return None
    base = home / ".cache"
    return base / "gmijax" if os.access(base if base.exists() else home, os.W_OK) else None


def _temporary() -> Path:
    """A folder of this user's below the one for temporary files, where anybody may write."""
    folder = Path(tempfile.gettempdir()) / f"gmijax-{os.geteuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise ConfigError(
            f"no home folder that can be written, and {folder} cannot be used "
            f"({error.strerror}); {_ADVICE}"
        ) from None
    # What others can write to would be run by us: compiled programs are code.
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
        raise ConfigError(
            f"no home folder that can be written, and {folder} is not this user's alone; {_ADVICE}"
        )
    return folder
