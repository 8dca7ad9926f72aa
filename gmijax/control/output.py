"""What a command was asked to print: it has failed if that cannot be written.

What a job prints of its progress is for `console`, and cannot end it.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from typing import TextIO

from gmijax.errors import GmijaxError


def write_output(text: str) -> None:
    """Writes to standard output; a reader that is gone, as of `| head`, has read enough.

    Raises:
      GmijaxError: it cannot be written, e.g. because the disk is full.
    """
    stream: TextIO | None = sys.stdout  # None where it is closed.
    try:
        if stream is None:
            raise ValueError("it is closed")
        stream.write(text)
        stream.flush()
    except BrokenPipeError:
        discard(stream)
    except (OSError, ValueError) as error:
        discard(stream)
        raise not_written(why_of(error)) from None


def not_written(why: str) -> GmijaxError:
    """What a command that could not print its answer raises."""
    return GmijaxError(f"the output cannot be written ({why})")


def why_of(error: OSError | ValueError) -> str:
    """What went wrong with a stream, in a few words."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


class _Collected(io.StringIO):
    """Text for a stream, as a console would print it there."""

    def __init__(self, stream: TextIO | None) -> None:
        super().__init__()
        self._is_terminal = stream is not None and not stream.closed and stream.isatty()

    def isatty(self) -> bool:
        return self._is_terminal


@contextmanager
def as_output() -> Iterator[None]:
    """Writes what is printed within as `write_output` does, and raises as that."""
    collected = _Collected(sys.stdout)
    with redirect_stdout(collected):
        yield
    write_output(collected.getvalue())


def discard(stream: TextIO | None) -> None:
    """Sends what is left in the buffer of a stream nowhere: it would fail as Python ends."""
    if stream is None:
        return
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
