"""Why a GMI ended, in one line, and which of several failures came first."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gmijax import errors
from gmijax.errors import CollectiveError, ConfigError, GmiFailed, GmijaxError, printable
from gmijax.rundir import GmiPaths, read_json

_TAIL_BYTES = 8192
_MAX_LINE = 300


class Failure(NamedTuple):
    """The end of a GMI that was no success.

    Attributes:
      gmi: its id.
      exit_code: as in `subprocess`: negative for the signal that ended the process.
      reason: one line.
      error_type: class name of the GMI's own exception, None where it left none.
      message: first line of that exception's message.
    """

    gmi: int
    exit_code: int
    reason: str
    error_type: str | None
    message: str

    @property
    def is_consequence(self) -> bool:
        """Whether the GMI says that another one is to blame."""
        return self.exit_code > 0 and _is_a(self.error_type, CollectiveError)

    def to_error(self) -> GmijaxError:
        """The exception for the user; bad input found inside a GMI stays bad input."""
        if self.exit_code > 0 and _is_a(self.error_type, ConfigError):
            return ConfigError(self.message)
        return GmiFailed(self.gmi, self.reason)


def describe_exit(gmi: int, exit_code: int, paths: GmiPaths) -> Failure:
    """Puts together what the GMI left behind: its error.json, else its last line on stderr."""
    error_type, message = _own_error(paths.error)
    own = f"{error_type}: {message}" if error_type else last_line(paths.stderr)
    how = f"exit code {exit_code}" if exit_code >= 0 else f"ended by {signal_name(-exit_code)}"
    if exit_code == -signal.SIGKILL and not own:
        own = "not killed by gmijax; perhaps the machine ran out of memory"
    return Failure(gmi, exit_code, f"{how}: {own}" if own else how, error_type, message)


def first_cause(failures: Sequence[Failure]) -> Failure:
    """The failure that most likely caused the others.

    A GMI that lost its peer may be seen to fail before that peer is; so a signal, and any
    error that is not about a peer, goes before errors of the exchange. While GMIs meet to form
    rings, jax aborts those whose peer is gone; so SIGABRT comes after all other causes.
    """
    return min(
        failures,
        key=lambda failure: (
            failure.is_consequence,
            failure.exit_code == -signal.SIGABRT,
            failure.exit_code >= 0,
        ),
    )


def signal_name(number: int) -> str:
    """`SIGKILL` for 9."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def last_line(path: Path) -> str:
    """The last non-empty line of a text file, shortened; empty where there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL_BYTES))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        return ""
    shown = (printable(line).strip() for line in reversed(lines))
    return next(filter(None, shown), "")[:_MAX_LINE]


def _own_error(path: Path) -> tuple[str | None, str]:
    try:
        data: dict[str, Any] = read_json(path)
        lines = str(data["message"]).strip().splitlines()
        return str(data["type"]), printable(lines[0])[:_MAX_LINE] if lines else ""
    except (OSError, json.JSONDecodeError, KeyError, TypeError):
        return None, ""


def _is_a(error_type: str | None, parent: type[GmijaxError]) -> bool:
    found = getattr(errors, error_type, None) if error_type else None
    return isinstance(found, type) and issubclass(found, parent)
