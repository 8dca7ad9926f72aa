"""The pictures of the evaluation, as SVG; each keeps its numbers, so a stale one can be found."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from html import unescape
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as Picture
from matplotlib.transforms import blended_transform_factory

from benchmarks.evaluation.evidence import LEAST, Ratio
from benchmarks.evaluation.figures import Figure
from benchmarks.evaluation.page import FINISHED, gains
from gmijax.runs.folder import write_text

FOLDER = Path(__file__).parents[2] / "docs" / "img"


class Bar(NamedTuple):
    """One of a picture.

    Attributes:
      name: to its left; empty: it belongs to the one above.
      low: its end.
      high: of a range, the other end.
      kind: `STEPS` or `FINISHED`.
      is_sure: whether commit, date and three runs back it.
    """

    name: str
    low: float
    high: float
    kind: str
    is_sure: bool


Groups = dict[str, list[Bar]]
"""Heading -> the bars below it."""

LEFT_OF_ONE, AROUND_ONE, RIGHT_OF_ONE = "#c55", "#ca4", "#2a7"

PALE = (
    "right of 1 is a gain; a thin line goes from the lowest case to the highest\n"
    f"pale: fewer than {LEAST} runs, or commit unknown"
)

SUMMARY = MappingProxyType(
    {
        "many trainings at once, over one after another": {
            "eight": "8 of ant",
            "mjlab": "8 of mjlab's Go1",
            "cleanrl": "8 of CleanRL's PPO",
        },
        "processes under MPS, over plain sharing": {"mps": "2 and 8 that serve"},
        "8 trainings in 8 processes, over one program": {"program": "8 of ant"},
        "one training in several GMIs, over one process": {
            "off_policy": "SAC, agent + learner",
            "best_plans": "PPO, 65,536 environments",
            "fixed_total": "PPO, 8,192 environments",
        },
        "agents and trainers apart, over synchronous": {
            "asynchronous_1": "one GPU",
            "asynchronous_2": "two GPUs",
        },
    }
)
"""Heading -> row of the advice -> name, from gains to losses."""


def summary() -> Groups:
    """What several GMIs on a GPU gain and lose: the figures of the advice."""
    of = gains()
    return {
        heading: [
            bar
            for row, name in names.items()
            for kind, found in of[row].items()
            for bar in _bar("" if kind == FINISHED else name, kind, found)
        ]
        for heading, names in SUMMARY.items()
    }


def _bar(name: str, kind: str, found: Sequence[Figure | Ratio | None]) -> Iterator[Bar]:
    """Of what was measured, if anything."""
    measured = [one for one in found if one is not None]
    if measured:
        ends = [one.median if isinstance(one, Figure) else float(one) for one in measured]
        is_sure = all(one.evidence.is_enough for one in measured)
        yield Bar(name, min(ends), max(ends), kind, is_sure)


PICTURES: MappingProxyType[str, tuple[Callable[[], Groups], str]] = MappingProxyType(
    {
        "evaluation-summary": (
            summary,
            "times the steps/s; hatched: times the trainings per hour\n" + PALE,
        ),
    }
)
"""Name -> its bars, and what their length is."""


def draw(folder: Path = FOLDER) -> None:
    """Writes all pictures."""
    for name, (bars, meaning) in PICTURES.items():
        _draw(bars(), meaning, folder / f"{name}.svg")


def is_current(name: str, folder: Path = FOLDER) -> bool:
    """Whether the numbers in a picture are those of the files of results."""
    path = folder / f"{name}.svg"
    return path.exists() and _numbers(PICTURES[name][0]()) in unescape(path.read_text())


def _numbers(groups: Groups) -> str:
    return json.dumps(
        {
            heading: [[*bar[:1], round(bar.low, 4), round(bar.high, 4), *bar[3:]] for bar in bars]
            for heading, bars in groups.items()
        }
    )


def _draw(groups: Groups, meaning: str, path: Path) -> None:
    rows = [row for heading, bars in groups.items() if bars for row in (heading, *bars)]
    # Narrow, so that a phone need not make the words much smaller.
    picture = Picture(figsize=(5.6, 1.0 + 0.22 * len(rows)), layout="constrained")
    FigureCanvasSVG(picture)
    axes: Axes = picture.subplots()
    from_left_edge = blended_transform_factory(picture.transFigure, axes.transData)
    for at, row in enumerate(rows):
        if isinstance(row, Bar):
            _draw_bar(axes, at, row)
        else:
            place = {"transform": from_left_edge, "va": "center", "in_layout": False}
            axes.text(0.01, at, row, weight="bold", **place)
    named = {at: row.name for at, row in enumerate(rows) if isinstance(row, Bar)}
    axes.set_yticks([*named], [*named.values()])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlim(0)
    axes.margins(x=0.1)
    picture.supxlabel(meaning, fontsize=9)
    axes.spines[["top", "right", "left"]].set_visible(False)
    _save(picture, path, _numbers(groups))


def _draw_bar(axes: Axes, at: int, bar: Bar) -> None:
    alpha, hatch = 1.0 if bar.is_sure else 0.45, "////" if bar.kind == FINISHED else None
    axes.barh(at, bar.low, color=_colour(bar), alpha=alpha, hatch=hatch, edgecolor="white")
    line = {"linewidth": 3, "solid_capstyle": "butt", "alpha": alpha}
    axes.plot([bar.low, bar.high], [at, at], color=_colour(bar), **line)
    axes.plot([1, 1], [at - 0.5, at + 0.5], color="black", linewidth=1)
    low, high = f"{bar.low:.2f}", f"{bar.high:.2f}"
    # Not on the line at 1, which would cross it out.
    place = {"xytext": (3, 0), "textcoords": "offset points", "va": "center"}
    axes.annotate(low if low == high else f"{low} to {high}", (max(bar.high, 1), at), **place)


def _colour(bar: Bar) -> str:
    return RIGHT_OF_ONE if bar.low >= 1 else LEFT_OF_ONE if bar.high < 1 else AROUND_ONE


def _save(picture: Picture, path: Path, numbers: str) -> None:
    metadata = {"Date": None, "Description": numbers}
    with mpl.rc_context({"svg.hashsalt": "gmijax", "svg.fonttype": "none"}):
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.savefig(path, format="svg", metadata=metadata)
    # Without spaces at the ends of lines, which checks of a commit complain about.
    write_text(path, "\n".join(line.rstrip() for line in path.read_text().splitlines()) + "\n")
