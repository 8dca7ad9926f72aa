"""What became of faults."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Came(NamedTuple):
    """A fault that came.

    Attributes:
      kind: of the deck.
      seed: what was drawn for it.
      outcome: `as wanted`, or what is wrong.
    """

    kind: str
    seed: int
    outcome: str


class Report(NamedTuple):
    """A trial and its faults.

    Attributes:
      came: its faults.
      leaks: what it left.
      lost: what was finished and must be done again.
    """

    came: list[Came]
    leaks: list[str]
    lost: list[str]

    @classmethod
    def of(cls, kind: str, seed: int, wrong: Sequence[str]) -> Report:
        """Of one fault, from everything that is wrong."""
        leaks = [text for text in wrong if text.startswith("leaked: ")]
        lost = [text for text in wrong if text.startswith("lost: ")]
        others = [text for text in wrong if text not in leaks and text not in lost]
        return cls([Came(kind, seed, "; ".join(others) or "as wanted")], leaks, lost)

    @property
    def is_good(self) -> bool:
        """Whether everything was as it must be."""
        return (
            not self.leaks and not self.lost and all(c.outcome == "as wanted" for c in self.came)
        )
