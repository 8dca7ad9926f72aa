"""What a job prints: it must never end the job, whatever becomes of the other end. No jax here."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import Any, TextIO

from rich.console import Console


class _Careful:
    """A text stream that is dropped at its first error: `train | head`, a closed terminal."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self.encoding = getattr(stream, "encoding", None) or "utf-8"

    def write(self, text: str) -> int:
        """Writes, or does nothing once that has failed."""
        if self._stream is not None:
            try:
                self._stream.write(text)
            except (OSError, ValueError):
                self._drop(self._stream)
        return len(text)

    def flush(self) -> None:
        """See `write`."""
        if self._stream is not None:
            try:
                self._stream.flush()
            except (OSError, ValueError):
                self._drop(self._stream)

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        with suppress(OSError, ValueError):
            return self._stream is not None and self._stream.isatty()
        return False

    def _drop(self, stream: TextIO) -> None:
        self._stream = None
        # What is left in its buffer would fail once more when Python ends.
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def open_console(*, show: bool) -> Console:
    """Where a job prints what the user may read: standard output, or nowhere."""
    # Without a standard output (`>&-`) it is None.
    stream: Any = _Careful(sys.stdout if show else None)
    return Console(file=stream, quiet=not show, soft_wrap=True, highlight=False)
