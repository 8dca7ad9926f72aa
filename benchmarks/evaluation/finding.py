"""What a check of the documents finds."""

from __future__ import annotations

from typing import NamedTuple


class Finding(NamedTuple):
    """A figure without a file, or one that differs from it.

    Attributes:
      file: the document.
      line: in it.
      text: what stands there.
      said: what the file of results says.
    """

    file: str
    line: int
    text: str
    said: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.text!r}: {self.said}"
