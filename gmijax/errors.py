"""Every exception gmijax raises on purpose.

GmijaxError
├── ConfigError              bad input; commands print one line and exit with code 2
│   └── BackendUnavailable   the wanted backend cannot be had on this machine
├── FolderLost               a folder was moved or removed while a job wrote into it
├── GmiFailed                a GMI ended with an error or a signal, or stopped making progress
├── NodeLost                 a machine of a job on several nodes is gone, or does not answer
├── CollectiveError          an exchange between GMIs failed
│   ├── PeerLost             the process of another GMI is gone
│   ├── CollectiveTimeout    another GMI did not arrive in time
│   ├── PipeClosed           the other end of a pipe was closed on purpose
│   ├── CudaError            CUDA refused something that an exchange needs
│   └── DeviceMemoryUnavailable  GPU memory that GMIs share cannot be had; on all of them alike
├── ParameterMismatch        GMIs that must hold equal parameters do not
├── SelfCheckFailed          matrix products are wrong on the share of a GMI
├── NonFiniteError           a loss, gradient or simulation became NaN or infinite
├── JobNotStarted            one job of a sweep or a pack cannot be started; others can
├── SweepFailed              jobs of a sweep failed; the others have run
└── JobInterrupted           the user asked the job to stop; commands exit with code 130
"""

from __future__ import annotations

import re
import time
import unicodedata
from pathlib import Path
from typing import NamedTuple

TERMINAL_COMMAND = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)?|[ -~])")
"""Commands to a terminal, which it does not show: colours, the cursor, its title."""


def printable(text: str) -> str:
    """One line of a program's output without commands to a terminal.

    Commands of terminals and control characters go, among them those that turn the direction of
    writing; tabs become blanks.
    """
    shown = TERMINAL_COMMAND.sub("", text).replace("\t", " ")
    return "".join(c for c in shown if unicodedata.category(c) not in ("Cc", "Cf"))


def lines_of(error: BaseException) -> list[str]:
    """The lines of an error's message that are not empty; its type's name if it has none."""
    lines = [line.strip() for line in str(error).splitlines()]
    return [line for line in lines if line] or [type(error).__name__]


def gist_of(text: str) -> str:
    """What a message of several lines says: its first line, and the last if that announces it.

    Of two lines both: MuJoCo has what is wrong with a model in one, and where in the other.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if len(lines) > 1 and lines[0].endswith(":"):
        return f"{lines[0]} {lines[-1]}"
    return "; ".join(lines if len(lines) == 2 else lines[:1])


def with_type(kind: str, message: str) -> str:
    """`ValueError: message`; the type's name alone where an error has no message."""
    return f"{kind}: {message}" if message else kind


class GmijaxError(Exception):
    """Base of all errors that gmijax raises on purpose."""


class ConfigError(GmijaxError):
    """Bad input: the message says what, which value, and which values are allowed."""


class NoCheckpointYet(ConfigError):
    """The checkpoint that is asked for is still to come: the run is being trained.

    Attributes:
      run: folder of the run.
    """

    def __init__(self, message: str, run: Path) -> None:
        super().__init__(message)
        self.run = run


class MissingKey(ConfigError):
    """A key that has no default is not given."""


class DamagedFile(ConfigError):
    """A file of a run cannot be read, or its content is not of the kind that its name promises.

    Attributes:
      cause: why, without the file.
    """

    def __init__(self, what: str, cause: str) -> None:
        super().__init__(f"{what} ({cause})")
        self.cause = cause


class BackendUnavailable(ConfigError):
    """The requested backend is unavailable on this machine; the message names what is missing."""


class FolderLost(GmijaxError):
    """A folder was moved, removed or replaced while a job wrote into it; it has ended."""


class ReportedError(NamedTuple):
    """The exception that ended a GMI, in words.

    Attributes:
      type: its class.
      message: of the exception.
      traceback: with the message, as Python prints it.
      missing: ids of the GMIs that it waited for in vain, of a `CollectiveTimeout`.
    """

    type: str
    message: str
    traceback: str
    missing: tuple[int, ...] = ()


class GmiFailed(GmijaxError):
    """A GMI ended with an error or a signal, or stopped making progress.

    Attributes:
      gmi: id of the first GMI that failed.
      reason: one line: the GMI's own error, its exit code, or the signal that ended it.
      iteration: training iterations that it had done.
      error: its own exception, None where it left none.
      exit_code: of its process, negative for the signal that ended it; 0 while it ran.
      is_final: whether to try again cannot help, whatever the cause.
      seen_s: when the failure was seen, `time.monotonic`.
    """

    def __init__(
        self,
        gmi: int,
        reason: str,
        *,
        iteration: int = 0,
        error: ReportedError | None = None,
        exit_code: int = 0,
    ) -> None:
        super().__init__(f"GMI {gmi} failed: {reason}")
        self.gmi = gmi
        self.reason = reason
        self.iteration = iteration
        self.error = error
        self.exit_code = exit_code
        self.is_final = False
        self.seen_s = time.monotonic()


class NodeLost(GmijaxError):
    """A machine of a job on several nodes is gone, or does not answer; named as a GMI's error."""


class CollectiveError(GmijaxError):
    """An exchange between GMIs failed."""


class PeerLost(CollectiveError):
    """The process of another GMI, of id `peer`, is gone."""

    def __init__(self, gmi: int, peer: int, operation: str, step: int) -> None:
        super().__init__(f"GMI {gmi}: GMI {peer} is gone during {operation}, step {step}")
        self.peer = peer


class CollectiveTimeout(CollectiveError):
    """Other GMIs, those of the ids in `missing`, did not arrive in time."""

    def __init__(
        self, gmi: int, missing: tuple[int, ...], operation: str, step: int, timeout_s: float
    ) -> None:
        super().__init__(
            f"GMI {gmi}: waited {timeout_s:g} s in {operation}, step {step}, "
            f"for GMIs {list(missing)}"
        )
        self.missing = missing


class PipeClosed(CollectiveError):
    """The other end of a pipe was closed on purpose: nothing more comes, or is wanted."""

    def __init__(self, gmi: int, peer: int, operation: str) -> None:
        super().__init__(f"GMI {gmi}: GMI {peer} has closed its pipe, in {operation}")


class CudaError(CollectiveError):
    """CUDA refused something that an exchange needs; the message has its words."""


class DeviceMemoryUnavailable(CollectiveError):
    """GPU memory that GMIs share cannot be had here; raised on all ranks of the job alike."""


class ParameterMismatch(GmijaxError):
    """GMIs that must hold bit-identical parameters do not."""


class SelfCheckFailed(GmijaxError):
    """Matrix products are wrong on the share of a GMI; the message names them and the share."""


class NonFiniteError(GmijaxError):
    """A loss, gradient or simulation became NaN or infinite; the message has the location."""


class JobNotStarted(GmijaxError):
    """One job of a sweep or a pack cannot be started, others can; the message does not name it."""


class SweepFailed(GmijaxError):
    """Jobs of a sweep failed, and all others have run; the message names the first one."""


class JobInterrupted(GmijaxError):
    """The user asked the job to stop, and it did; once trained a little, it saved first."""
