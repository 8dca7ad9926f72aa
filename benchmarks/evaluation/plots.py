"""The pictures of the evaluation, as SVG; each keeps its numbers, so a stale one can be told."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from html import unescape
from pathlib import Path
from types import MappingProxyType

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as Picture
from matplotlib.transforms import blended_transform_factory

from benchmarks.evaluation.paper import lgr_gain
from benchmarks.evaluation.serving_tables import TASKS, mps_over_share
from benchmarks.evaluation.sweep_tables import first_gains
from benchmarks.evaluation.tables import (
    LAYOUTS,
    fixed_total_ratios,
    over_one_gpu,
    reduction_gain,
)
from gmijax.runs.folder import write_text

FOLDER = Path(__file__).parents[2] / "docs" / "img"
Bars = dict[str, float | None]
Groups = dict[str, Bars]
"""Heading -> the bars below it."""

LEFT_OF_ONE, RIGHT_OF_ONE, OF_THE_PAPER = "#c55", "#2a7", "#999"
PAPER = "paper"


def summary() -> Groups:
    """What several GMIs on a GPU gain and lose, in the order of the advice."""
    return {
        "small training runs at once, over one after another": {
            way.removesuffix(", auto"): gain.median
            for way, gain in first_gains().items()
            if way.endswith(", auto")
        },
        "serving under MPS, over plain sharing": mps_gains(),
        "one large training run in several GMIs, over one process": one_training(),
        "one GMI on each of several GPUs, over one GPU": {
            f"{gpus} GPUs": over_one_gpu(gpus) for gpus in (2, 4)
        },
    }


def mps_gains() -> Bars:
    """Serving under MPS over plain sharing, with the fewest and the most GMIs."""
    return {f"{task}, {n} GMIs": mps_over_share(task, n) for task in TASKS for n in (2, 8)}


def one_training() -> Bars:
    """The same environments in several GMIs over one process, without the names of files."""
    bars: Bars = {}
    for what, gain in fixed_total_ratios().items():
        name = what.partition(" (")[0]
        while name in bars:
            name += ", again"
        bars[name] = gain
    return bars


def lgr() -> Groups:
    """LGR here and in the paper."""
    groups: Groups = {}
    for task in ("ant", "humanoid", "shadow_hand"):
        bars = groups.setdefault(task, {})
        for at, name in LAYOUTS.items():
            bars[name] = reduction_gain(task, at, "one_shot")
            bars[f"{name}, {PAPER}"] = lgr_gain(task, at)
    return groups


PICTURES: MappingProxyType[str, tuple[Callable[[], Groups], str]] = MappingProxyType(
    {
        "evaluation-summary": (summary, "times the throughput; right of 1 is a gain"),
        "evaluation-lgr": (lgr, "times the steps/s of mpr; right of 1 is a gain"),
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
            heading: {name: None if v is None else round(v, 4) for name, v in bars.items()}
            for heading, bars in groups.items()
        }
    )


def _draw(groups: Groups, meaning: str, path: Path) -> None:
    rows = list(_rows(groups))
    # Narrow, so that a phone need not make the words much smaller.
    picture = Picture(figsize=(5.6, 0.6 + 0.22 * len(rows)), layout="constrained")
    FigureCanvasSVG(picture)
    axes: Axes = picture.subplots()
    from_left_edge = blended_transform_factory(picture.transFigure, axes.transData)
    for at, (name, value) in enumerate(rows):
        if value is None:
            place = {"transform": from_left_edge, "va": "center", "in_layout": False}
            axes.text(0.01, at, name, weight="bold", **place)
            continue
        colour = RIGHT_OF_ONE if value >= 1 else LEFT_OF_ONE
        axes.barh(at, value, color=OF_THE_PAPER if name.endswith(PAPER) else colour)
        axes.plot([1, 1], [at - 0.5, at + 0.5], color="black", linewidth=1)
        # Not on the line at 1, which would cross it out.
        end = (max(value, 1), at)
        axes.annotate(f"{value:.2f}", end, (3, 0), textcoords="offset points", va="center")
    axes.set_yticks(*_ticks(rows))
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlim(0)
    axes.margins(x=0.1)
    axes.set_xlabel(meaning)
    axes.spines[["top", "right", "left"]].set_visible(False)
    metadata = {"Date": None, "Description": _numbers(groups)}
    with mpl.rc_context({"svg.hashsalt": "gmijax", "svg.fonttype": "none"}):
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.savefig(path, format="svg", metadata=metadata)
    # Without spaces at the ends of lines, which checks of a commit complain about.
    write_text(path, "\n".join(line.rstrip() for line in path.read_text().splitlines()) + "\n")


def _rows(groups: Groups) -> Iterator[tuple[str, float | None]]:
    """Headings, without a value, and what was measured below each."""
    for heading, bars in groups.items():
        measured = {name: value for name, value in bars.items() if value is not None}
        if measured:
            yield heading, None
            yield from measured.items()


def _ticks(rows: Sequence[tuple[str, float | None]]) -> tuple[list[int], list[str]]:
    """Where the names of bars stand, and the names."""
    bars = [(at, name) for at, (name, value) in enumerate(rows) if value is not None]
    return [at for at, _ in bars], [name for _, name in bars]
