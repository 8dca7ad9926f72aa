"""One problem that a check of the documents finds."""

from __future__ import annotations

from typing import NamedTuple


class Finding(NamedTuple):
    """A figure without a file, or one that differs from it.

    Attributes:
      file: the document.
      line: its number in the document.
      text: what is written there.
      problem: what is wrong with it.
    """

    file: str
    line: int
    text: str
    problem: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.text!r}: {self.problem}"
