"""What a search shows and leaves: progress, table, sentence, report, plot."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from gmijax.autotune.grid import Grid, Measured, NotRunnable, Point
from gmijax.autotune.search import SearchOutcome, SearchPoint
from gmijax.autotune.workloads import Split
from gmijax.runs.names import counted
from gmijax.supervise.watched_gmi import GmiStatus

_LONGEST_REASON = 90


class SearchDisplay:
    """A bar of the time budget on a terminal, a line per profile everywhere."""

    def __init__(self, console: Console, budget_s: float) -> None:
        self._console = console
        self._budget_s = budget_s
        self._has_begun = False
        self._started_s = time.monotonic()
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn(f"of at most {budget_s:.0f} s"),
            console=console,
            transient=True,
            disable=not console.is_interactive,
        )
        self._task = self._bar.add_task("search", total=budget_s)

    def __enter__(self) -> SearchDisplay:
        self._started_s = time.monotonic()
        self._bar.start()
        return self

    def begin(self) -> None:
        """Prints once what takes the time, before the first profile that is not in the store."""
        if not self._has_begun:
            self._has_begun = True
            self._console.print(
                "every profile is a short job of its own, which compiles its programs first; "
                f"at most {self._budget_s:.0f} s in all"
            )

    def __exit__(self, *exc: Any) -> None:
        self._bar.stop()

    def watch(self, point: Point, gmis: Sequence[GmiStatus]) -> None:
        """Shows how far the running profile is; called about 20 times a second."""
        slowest = min(gmis, key=lambda gmi: gmi.iteration)
        self._bar.update(
            self._task,
            completed=time.monotonic() - self._started_s,
            description=f"{point}: GMI {slowest.gmi} {slowest.state}",
        )

    def done(self, point: Point, result: Measured | NotRunnable, wall_s: float) -> None:
        """Prints what a profile found."""
        self._console.print(f"{point}: {_found(point, result)} ({wall_s:.0f} s)")


def verdict(outcome: SearchOutcome, grid: Grid, num_gpus: int, split: Split | None = None) -> str:
    """The answer and what it is worth, in words; only for an outcome with a best point."""
    assert outcome.best is not None
    top = outcome.best
    several = _highest(outcome, lambda gmis: gmis > 1)
    one = _highest(outcome, lambda gmis: gmis == 1)
    gpus = "" if num_gpus == 1 else f" on {num_gpus} GPUs (projected from one)"
    text = f"{_answer(top, split)}, {top.point.impl}: {top.projected:,.0f} env steps/s"
    text += gpus if split is None else _reason_of(split, top)
    gmi = "serving GMI" if top.point.trainers else "GMI"
    if top.point.gmis_per_gpu == 1 and several is not None:
        text += (
            f"; one {gmi} is enough here: the best with several, {several.point}, makes "
            f"{several.projected / top.projected:.2f} of that"
        )
    elif top.point.gmis_per_gpu > 1 and one is not None:
        text += f"; {top.projected / one.projected:.2f} times the best with one {gmi}, {one.point}"
        if one.point.num_envs == max(grid.num_envs):
            text += (
                ", the most environments that it was given: with more it may come closer "
                "(search.num_envs)"
            )
    if not outcome.complete:
        text += f"; the budget ended the search after {len(outcome.visited)} points"
    return text


def table(outcome: SearchOutcome) -> Table:
    """One row per point, best marked."""
    shown = Table(title="environment steps per second")
    for heading in ("GMIs", "envs", "MJX", "one GMI", "whole job", "MiB", "saturation"):
        shown.add_column(heading, justify="right", overflow="fold")
    has_trainers = any(one.point.trainers for one in outcome.visited)
    if has_trainers:
        for heading in ("could act, k", "could learn, k"):
            shown.add_column(heading, justify="right", overflow="fold")
    shown.add_column("choice")
    for one in sorted(outcome.visited, key=lambda one: one.point):
        point, result = one.point, one.result
        cells = [point.gmis, str(point.num_envs), point.impl]
        note = "best" if one == outcome.best else ""
        if isinstance(result, NotRunnable):
            cells += ["-"] * (6 if has_trainers else 4)
            note = result.reason[:_LONGEST_REASON]
        else:
            sat = "" if one.saturation is None else f"{one.saturation:.2f}"
            cells += [f"{result.env_steps_per_s:,.0f}", f"{one.projected:,.0f}"]
            cells += [f"{result.memory_mib:,.0f}", sat]
            if has_trainers:
                rates = result.acting_per_s, result.learning_per_s
                cells += [f"{rate / 1000:,.1f}" for rate in rates]
        shown.add_row(*cells, note, style="bold" if one == outcome.best else None)
    return shown


def plain_data(outcome: SearchOutcome, reason: str, split: Split | None = None) -> dict[str, Any]:
    """The outcome for `search.json`."""
    best = outcome.best
    gpus = {} if split is None else {f"{what}_gpus": n for what, n in split._asdict().items()}
    return {
        "best": best and {**_where(best.point), **gpus, "projected": best.projected},
        "reason": reason,
        "complete": outcome.complete,
        "points": [
            {
                **_where(one.point),
                **_what(one.point, one.result),
                "saturation": _json_number(one.saturation),
                "projected": one.projected,
            }
            for one in outcome.visited
        ],
    }


def draw(outcome: SearchOutcome, picture: Path, title: str) -> None:
    """Draws throughput of a GPU and memory of a GMI over environments, a line per GMIs per GPU."""
    # Imported here: it costs half a second that no other use of this module should pay.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    rows = sorted({one.point._replace(num_envs=0) for one in outcome.visited})
    impls = sorted({row.impl for row in rows})
    for row in rows:
        ran = sorted(
            (one.point.num_envs, one.result)
            for one in outcome.visited
            if one.point._replace(num_envs=0) == row and isinstance(one.result, Measured)
        )
        gmis = row.gmis_per_gpu
        style = {
            "color": f"C{gmis - 1}",
            "linestyle": ("-", "--")[impls.index(row.impl)],
            "marker": "o^sv"[max(0, row.trainers - 1) % 4],
            "label": f"{row.gmis}, {row.impl}",
        }
        sizes = [size for size, _ in ran]
        left.plot(sizes, [gmis * one.env_steps_per_s for _, one in ran], **style)
        right.plot(sizes, [one.memory_mib for _, one in ran], **style)
    for axes, what in ((left, "env steps/s of one GPU"), (right, "peak memory of a GMI, MiB")):
        axes.set(xlabel="environments per GMI", ylabel=what, xscale="log")
        axes.set_ylim(0, 1.05 * axes.get_ylim()[1])
        ticks = sorted({size for line in axes.lines for size in line.get_xdata()})
        axes.set_xticks(ticks, labels=[f"{size:,.0f}" for size in ticks])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    left.legend(title="GMIs per GPU", fontsize="small")
    figure.suptitle(title, parse_math=False)
    figure.savefig(picture, dpi=120)


def _found(point: Point, result: Measured | NotRunnable) -> str:
    if isinstance(result, NotRunnable):
        return f"not runnable: {result.reason}"
    if point.trainers:
        return (
            f"{point.gmis_per_gpu * result.env_steps_per_s:,.0f} env steps/s, agents could make "
            f"{result.acting_per_s:,.0f}, trainers learn from {result.learning_per_s:,.0f}, "
            f"{result.memory_mib:,.0f} MiB"
        )
    return (
        f"{result.env_steps_per_s:,.0f} env steps/s a GMI, "
        f"{point.gmis_per_gpu * result.env_steps_per_s:,.0f} a GPU, {result.memory_mib:,.0f} MiB"
    )


def _highest(outcome: SearchOutcome, wanted: Any) -> SearchPoint | None:
    fitting = [one for one in outcome.visited if one.projected and wanted(one.point.gmis_per_gpu)]
    return max(fitting, key=lambda one: one.projected) if fitting else None


def _answer(top: SearchPoint, split: Split | None) -> str:
    """Which GMIs are where, in words."""
    point = top.point
    envs = f"{point.num_envs} environments each"
    if not point.trainers:
        return f"{counted(point.gmis_per_gpu, 'GMI')} per GPU with {envs}"
    serving = counted(point.gmis_per_gpu, "serving GMI")
    training = counted(point.trainers, "training GMI")
    if split is None:
        return f"{serving} with {envs} and {training} per GPU"
    return (
        f"{counted(split.serving, 'GPU')} with {serving} of {envs}, "
        f"{counted(split.training, 'GPU')} with {training}"
    )


def _reason_of(split: Split, top: SearchPoint) -> str:
    assert isinstance(top.result, Measured)
    acting, learning = top.result.acting_per_s, top.result.learning_per_s
    slower = "agents" if split.serving * acting < split.training * learning else "trainers"
    return (
        f" (projected from one GPU of each kind: agents could make {acting:,.0f}, trainers learn "
        f"from {learning:,.0f}; with so many GPUs {slower} are the slower side)"
    )


def _where(point: Point) -> dict[str, Any]:
    return _without(point._asdict(), () if point.trainers else ("trainers",))


def _what(point: Point, result: Measured | NotRunnable) -> dict[str, Any]:
    rates = ("acting_per_s", "learning_per_s")
    return _without(result._asdict(), () if point.trainers else rates)


def _without(data: dict[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    return {key: value for key, value in data.items() if key not in keys}


def _json_number(value: float | None) -> float | str | None:
    return "infinite" if value is not None and math.isinf(value) else value
