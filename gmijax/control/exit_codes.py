"""Exit codes of commands: 0 success, 2 bad input (one line), 130 interrupted, 1 anything else."""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Final

from gmijax.errors import ConfigError, GmijaxError, JobInterrupted
from gmijax.runs.names import nearby
from gmijax.supervise.stop_signals import STOP_SIGNALS

EXIT_OK: Final = 0
EXIT_FAILED: Final = 1
EXIT_BAD_INPUT: Final = 2
EXIT_INTERRUPTED: Final = 130

_OF_DISKS: Final = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)
"""Errors of a file that no command can help."""

OF_KINDS: Final = (errno.EISDIR, errno.ENOTDIR, errno.EEXIST)
"""A folder stands where a command writes a file, or a file where it makes a folder."""


def exit_code_of(name: str, run: Callable[[], object]) -> int:
    """Runs the command `name` and turns every error into its exit code."""
    try:
        with _interrupted_by_signals():
            _require_working_folder()
            run()
        return EXIT_OK
    except ConfigError as error:
        _complain(name, error)
        return EXIT_BAD_INPUT
    except (JobInterrupted, KeyboardInterrupt) as error:
        _complain(name, error if str(error) else "interrupted")
        return EXIT_INTERRUPTED
    except GmijaxError as error:
        _complain(name, error)
        return EXIT_FAILED
    except OSError as error:
        if error.errno not in (*_OF_DISKS, *OF_KINDS):
            raise  # It may be a fault of gmijax.
        where = error.filename2 or error.filename
        _complain(name, f"{nearby(Path(where)) if where else 'a file'}: {error.strerror}")
        return EXIT_BAD_INPUT if error.errno in OF_KINDS else EXIT_FAILED


def _require_working_folder() -> None:
    try:
        os.getcwd()
    except FileNotFoundError:  # Else what is looked for first in it would be called missing.
        raise ConfigError(
            "the working directory no longer exists; change into another one"
        ) from None


@contextmanager
def _interrupted_by_signals() -> Iterator[None]:
    """Makes all stop signals do what Ctrl-C does, until a job handles them itself.

    What is ignored stays ignored, as by `nohup`.
    """
    default = {
        number: signal.signal(number, _interrupt)
        for number in STOP_SIGNALS
        if threading.current_thread() is threading.main_thread()
        and signal.getsignal(number) is signal.SIG_DFL
    }
    try:
        yield
    finally:
        for number, handler in default.items():
            signal.signal(number, handler)


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _complain(name: str, what: object) -> None:
    notes = getattr(what, "__notes__", [])
    text = "; ".join([str(what), *notes])
    # One line, whatever is in the values that it shows.
    shown = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    sys.stderr.write(f"gmijax.{name}: {shown}\n")
