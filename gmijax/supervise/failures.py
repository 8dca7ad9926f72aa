"""Why a GMI ended, in one line, and which of several failures came first."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from gmijax import errors
from gmijax.errors import (
    CollectiveTimeout,
    ConfigError,
    GmiFailed,
    GmijaxError,
    PeerLost,
    PipeClosed,
    ReportedError,
    printable,
)

_TAIL_BYTES = 8192
_MAX_LINE = 300


class Failure(NamedTuple):
    """The end of a GMI that was no success.

    Attributes:
      gmi: its id.
      exit_code: as in `subprocess`: negative for the signal that ended the process.
      reason: one line.
      iteration: training iterations done.
      error: the GMI's own exception, None where it left none.
    """

    gmi: int
    exit_code: int
    reason: str
    iteration: int
    error: ReportedError | None

    @property
    def is_consequence(self) -> bool:
        """Whether the GMI says that another one is to blame."""
        return self._is(PeerLost, CollectiveTimeout, PipeClosed)

    @property
    def is_timeout(self) -> bool:
        """Whether the GMI has waited in vain for another one."""
        return self._is(CollectiveTimeout)

    def to_error(self) -> GmijaxError:
        """The exception for the user; bad input found inside a GMI stays bad input."""
        if self.error is not None and self._is(ConfigError):
            return ConfigError(_first_line(self.error.message))
        return GmiFailed(self.gmi, self.reason, iteration=self.iteration, error=self.error)

    def _is(self, *parents: type[GmijaxError]) -> bool:
        if self.exit_code <= 0 or self.error is None:
            return False
        found = getattr(errors, self.error.type, None)
        return isinstance(found, type) and issubclass(found, parents)


def describe_exit(
    gmi: int, exit_code: int, error: ReportedError | None, stderr: Path, iteration: int = 0
) -> Failure:
    """Puts together what the GMI left behind: its own error, else its last line on stderr."""
    own = f"{error.type}: {_first_line(error.message)}" if error else last_line(stderr)
    how = f"exit code {exit_code}" if exit_code >= 0 else f"ended by {signal_name(-exit_code)}"
    if exit_code == -signal.SIGKILL and not own:
        own = "not killed by gmijax; perhaps the machine ran out of memory"
    return Failure(gmi, exit_code, f"{how}: {own}" if own else how, iteration, error)


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


def _first_line(text: str) -> str:
    lines = text.strip().splitlines()
    return printable(lines[0])[:_MAX_LINE] if lines else ""
