"""Follows the log of a program: whole lines of text, whatever bytes it prints."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Final

from gmijax.errors import TERMINAL_COMMAND

_ENDS: Final = re.compile(rb"[\r\n]+")

LONGEST_LINE: Final = 4096
"""Characters; what is longer is cut, so that a regular expression cannot take forever."""

_MOST_BYTES: Final = 1 << 20
"""Of one look. A program that prints faster is read from further on: a look must stay short."""


class OutputReader:
    """Follows a file that grows.

    Progress bars end their lines with a carriage return, so that ends a line too.

    Args:
      path: may not be there yet.
      start: byte from which on it is read.
    """

    def __init__(self, path: Path, start: int = 0) -> None:
        self._path, self._offset = path, start
        self._rest = b""

    def new(self) -> list[str]:
        """The lines that were completed since the last call, without escape codes."""
        try:
            with self._path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                if size < self._offset:  # It was truncated.
                    self._offset, self._rest = 0, b""
                if size - self._offset > _MOST_BYTES:
                    self._offset, self._rest = size - _MOST_BYTES, b""
                file.seek(self._offset)
                found = file.read(_MOST_BYTES)
        except OSError:
            return []
        self._offset += len(found)
        *lines, rest = _ENDS.split(self._rest + found)
        self._rest = rest[-_MOST_BYTES:]
        return [text for line in lines if (text := _text_of(line))]


def _text_of(line: bytes) -> str:
    # Escape codes are dropped before the cut: a bold title must not lose its end.
    text = line[: 4 * LONGEST_LINE].decode("utf-8", "replace")
    return TERMINAL_COMMAND.sub("", text)[:LONGEST_LINE]
