"""The evidence of a figure: the number of runs behind it, and the files of results it is from.

Figures keep it (`figures.Figure`), and so do their ratios and their text in a table of words.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

from benchmarks.records import Call
from gmijax.runs.names import counted

LEAST = 3
"""Runs of each case that a figure needs before a reader can rely on it."""


class Source(NamedTuple):
    """A call of a file of results.

    Attributes:
      file: its name without `.json`.
      has_origin: whether commit and date of the call are known.
      gpu: its kind, e.g. `H200`; empty if there was none or the file does not have it.
    """

    file: str
    has_origin: bool
    gpu: str = ""


class Evidence(NamedTuple):
    """The runs and files behind one figure, or behind several together.

    Attributes:
      repeats: runs of the case that ran least often.
      sources: the calls that all the figures are from.
      unit: what was repeated.
    """

    repeats: int
    sources: frozenset[Source] = frozenset()
    unit: str = "run"

    @property
    def has_origin(self) -> bool:
        """Whether commit and date are known of all sources."""
        return bool(self.sources) and all(one.has_origin for one in self.sources)

    @property
    def is_enough(self) -> bool:
        """Whether it has commit, date and at least `LEAST` runs."""
        return self.has_origin and self.repeats >= LEAST

    def __str__(self) -> str:
        gpus = sorted({one.gpu for one in self.sources if one.gpu})
        unknown = [] if self.has_origin else ["commit unknown"]
        return ", ".join([" and ".join(gpus) or "CPU", counted(self.repeats, self.unit), *unknown])


class Ratio(float):
    """A ratio of two figures.

    Attributes:
      evidence: of both figures together.
    """

    evidence: Evidence

    def __new__(cls, value: float, evidence: Evidence) -> Ratio:
        """A float that keeps its evidence."""
        made = super().__new__(cls, value)
        made.evidence = evidence
        return made


class FigureText(NamedTuple):
    """The text of one or several figures, as a table of words shows it.

    Attributes:
      text: as written.
      evidence: of the figures in the text; None if there are none.
    """

    text: str
    evidence: Evidence | None

    def __str__(self) -> str:
        return self.text


def source(file: str, call: Call) -> Source:
    """A call of `<file>.json`."""
    gpu = re.search(r"NVIDIA (\w+)", call.device or "")
    return Source(file, bool(call.commit and call.date), gpu[1] if gpu else "")


def together(parts: Iterable[Evidence]) -> Evidence | None:
    """The evidence of several figures: the fewest runs, and all files. None if there are none."""
    found = list(parts)
    if not found:
        return None
    sources = frozenset[Source]().union(*(one.sources for one in found))
    units = {one.unit for one in found}
    unit = units.pop() if len(units) == 1 else "run"
    return Evidence(min(one.repeats for one in found), sources, unit)
