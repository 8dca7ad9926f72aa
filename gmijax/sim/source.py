"""Custom tasks by file and name: `path/to/file.py:make`. No jax here: the controller checks them.

Every GMI is a process of its own and loads the task anew, so a task must be something that a file
and a name define.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gmijax.config import EnvConfig
from gmijax.errors import ConfigError
from gmijax.runs.names import nearby


def split(name: str) -> tuple[Path, str]:
    """File and function of `PATH.py:FUNCTION`.

    Raises:
      ConfigError: `name` has another form, or there is no such file.
    """
    path, colon, function = name.rpartition(":")
    if not (colon and path.endswith(".py") and function.isidentifier()):
        raise ConfigError(f"env={name}: expected PATH.py:FUNCTION, e.g. path/to/cart.py:make")
    if not os.path.isfile(path):  # Unlike `Path.is_file` it takes any text.
        raise ConfigError(f"env={nearby(Path(name))}: no such file")
    return Path(path).resolve(), function


def names_file(name: str) -> bool:
    """Whether a file is meant rather than a task that is known by its name."""
    return any(letter in name for letter in "/:.")


def reference(make: Callable[..., Any]) -> str:
    """`PATH.py:FUNCTION` of a function at the top level of a file.

    Raises:
      ConfigError: other processes could not find it: a lambda, a method, a function inside of
        another one, or one that was typed into a notebook or an interpreter.
    """
    name = getattr(make, "__qualname__", repr(make))
    module = sys.modules.get(getattr(make, "__module__", ""))
    file = getattr(module, "__file__", None)
    if file is None or not Path(file).is_file():
        raise ConfigError(
            f"env={name}: not in a file; GMIs are processes of their own, so write the function "
            "into a file and give path/to/file.py:NAME"
        )
    if getattr(module, name, None) is not make:
        raise ConfigError(
            f"env={name}: not a function at the top level of {file}; GMIs find it there by name"
        )
    return f"{Path(file).resolve()}:{name}"


def pinned(env: EnvConfig) -> EnvConfig:
    """The same task; a custom one by its absolute path, with the digest of its file.

    Raises:
      ConfigError: the file is not there, or its digest is not the one that `env` notes already.
    """
    if env.suite != "custom":
        return env
    path, function = split(str(env.name))
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ConfigError(f"env={nearby(path)}: cannot be read ({error.strerror})") from None
    if env.source_sha256 not in (None, digest):
        # Opening a run is no consent to execute whatever its file holds by now.
        how = "has changed" if env.source_sha256 else "may have changed"
        key = shlex.quote(f"env={nearby(path)}:{function}")
        raise ConfigError(
            f"{nearby(path)} {how} since this run was trained, so it was not executed. To use "
            f"the file as it is now, add {key}"
        )
    return dataclasses.replace(env, name=f"{path}:{function}", source_sha256=digest)


def opened(env: EnvConfig, name: str | None) -> EnvConfig:
    """The task of a saved run, pinned.

    Args:
      env: as the run noted it.
      name: the custom task's file and function as they are now; None: those of the run.

    Raises:
      ConfigError: see `pinned`, or `name` is that of another task.
    """
    if name is None:
        return pinned(env)
    named = dataclasses.replace(env, suite="custom", name=name, source_sha256=None)
    if named.label != env.label:
        raise ConfigError(f"env={name}: the run was trained on {env.label}")
    return pinned(named)


def executed(env: EnvConfig) -> str | None:
    """Names the file that opening a saved run executes, None where its task has none."""
    if env.suite != "custom":
        return None
    return f"custom task: this executes {nearby(Path(str(env.name)))}, the file of the run's task"


def changes(env: EnvConfig, saved: Mapping[str, Any]) -> str | None:
    """The message that the file of a pinned custom task is not that of a saved run.

    Args:
      env: the task, `pinned`.
      saved: the group `env` of that run's configuration, as plain data.

    Returns:
      A sentence, None where nothing has changed.
    """
    if env.source_sha256 in (None, saved.get("source_sha256")):
        return None
    return f"custom task: {nearby(Path(str(env.name)))} has changed since the run was started"
