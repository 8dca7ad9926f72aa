"""The pictures of the page, as SVG; each keeps its numbers, so that a stale one can be told."""

from __future__ import annotations

import json
from collections.abc import Callable
from html import unescape
from pathlib import Path
from types import MappingProxyType

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as Picture

from benchmarks.evaluation.figures import ratio
from benchmarks.evaluation.other_tables import IMPLS, mps_over_share
from benchmarks.evaluation.paper import lgr_gain
from benchmarks.evaluation.tables import LAYOUTS, fixed_total_ratios, small_gmis
from gmijax.runs.folder import write_text

FOLDER = Path(__file__).parents[2] / "docs" / "img"
Bars = dict[str, float | None]


def summary() -> Bars:
    """What several GMIs on a GPU gain and lose."""
    kept: Bars = {
        f"in {what}, over one process": gain for what, gain in fixed_total_ratios().items()
    }
    small = small_gmis()
    for gmis in (4, 10):
        gain = small[gmis] / small[1] if {1, gmis} <= small.keys() else None
        kept[f"{gmis} small GMIs over one small process"] = gain
    for task in IMPLS:
        for gmis in (2, 8):
            name = f"MPS over plain sharing, {task}, {gmis} GMIs"
            kept[name] = mps_over_share(task, gmis)
    return kept


def lgr() -> Bars:
    """LGR here and in the paper."""
    bars: Bars = {}
    for task in ("ant", "humanoid", "shadow_hand"):
        for at, name in LAYOUTS.items():
            file = f"lgr-{task}-one_shot"
            bars[f"{task}, {name}: here"] = ratio(file, f"{at} one_shot", f"{at} mpr")
            bars[f"{task}, {name}: paper"] = lgr_gain(task, at)
    return bars


PICTURES: MappingProxyType[str, tuple[Callable[[], Bars], str]] = MappingProxyType(
    {
        "evaluation-summary": (
            summary,
            "times as many steps/s; 1 is even",
        ),
        "evaluation-lgr": (lgr, "times as many steps/s as mpr"),
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


def _numbers(bars: Bars) -> str:
    return json.dumps({key: None if v is None else round(v, 4) for key, v in bars.items()})


def _draw(bars: Bars, meaning: str, path: Path) -> None:
    measured = {name: value for name, value in bars.items() if value is not None}
    picture = Picture(figsize=(8, 0.6 + 0.24 * len(measured)), layout="constrained")
    FigureCanvasSVG(picture)
    axes: Axes = picture.subplots()
    colours = ["#2a7" if value >= 1 else "#c55" for value in measured.values()]
    colours = [
        "#999" if name.endswith("paper") else colour
        for name, colour in zip(measured, colours, strict=True)
    ]
    axes.barh(list(measured), list(measured.values()), color=colours)
    axes.bar_label(axes.containers[0], fmt="%.2f", padding=3)  # pyright: ignore[reportArgumentType]
    axes.axvline(1, color="black", linewidth=1)
    axes.invert_yaxis()
    axes.set_xlabel(meaning)
    axes.margins(x=0.1)
    axes.spines[["top", "right"]].set_visible(False)
    metadata = {"Date": None, "Description": _numbers(bars)}
    with mpl.rc_context({"svg.hashsalt": "gmijax", "svg.fonttype": "none"}):
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.savefig(path, format="svg", metadata=metadata)
    # Without spaces at the ends of lines, which checks of a commit complain about.
    write_text(path, "\n".join(line.rstrip() for line in path.read_text().splitlines()) + "\n")
