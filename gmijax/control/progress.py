"""The progress of a job: a live panel on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gmijax.control.display import LiveDisplay, bar, clock
from gmijax.control.phases import BEFORE_RUNNING, Phases
from gmijax.control.time_left import TimeLeft
from gmijax.runs.compile_times import CompileTime
from gmijax.supervise.watched_gmi import GmiStatus

_LINE_EVERY_S: Final = 30.0
"""Between two plain lines."""


class ConsoleProgress:
    """Phase, environment steps per second, return, ETA; of several GMIs also their states.

    Args:
      console: nothing is shown on a quiet one.
      new: the lines of metrics that came since the last call; a job may have none at all.
      num_timesteps: environment steps of the whole job.
      compile_time: what is known of the time that compiling takes; None: nothing.
      work: what the job does once it runs, for one without metrics.
    """

    def __init__(
        self,
        console: Console,
        new: Callable[[], Sequence[dict[str, Any]]],
        num_timesteps: int,
        compile_time: CompileTime | None = None,
        work: str = "",
    ) -> None:
        self._console = console
        self._new = new
        self._num_timesteps = num_timesteps
        self._work = work
        self._phases = Phases(compile_time, work or "running")
        self._line: dict[str, Any] = {}
        self._evaluated: float | None = None
        self._left = TimeLeft()
        self._shown: tuple[str, int | None] = ("", None)
        self._shown_s = 0.0
        self._display = LiveDisplay(console)

    def __enter__(self) -> ConsoleProgress:
        self._display.__enter__()
        return self

    def __exit__(self, *exc: Any) -> None:
        self._display.__exit__(*exc)
        # A panel is gone then; a line that was printed is not printed again.
        if self._line and (self._display.has_panel or self._line["env_steps"] != self._shown[1]):
            self._console.print(self._text())

    def update(self, gmis: Sequence[GmiStatus]) -> None:
        """Called about 20 times a second."""
        self._display.show(lambda: self._show(gmis))

    def _show(self, gmis: Sequence[GmiStatus]) -> Table | None:
        for line in self._new():
            self._line = line
            self._evaluated = line.get("eval/return", self._evaluated)
        if self._line:
            self._left.note(self._line["env_steps"])
        if (news := self._phases.enter(gmis)) is not None:
            self._console.print(news, style="dim")
        if self._display.has_panel:
            return self._panel(gmis)
        self._print_now_and_then(gmis)
        return None

    def _print_now_and_then(self, gmis: Sequence[GmiStatus]) -> None:
        now_s, steps = time.monotonic(), self._line.get("env_steps")
        phase, is_due = self._phases.now, now_s - self._shown_s > _LINE_EVERY_S
        if phase == self._shown[0] and not is_due:
            return
        if self._has_figures or self._work or phase not in ("running", "stopping"):
            text = self._text() if self._has_figures else self._phases.text()
            states = f"  [{_states(gmis)}]" if len(gmis) > 1 else ""
            self._console.print(f"{text}{states}")
            self._shown, self._shown_s = (phase, steps), now_s

    def _panel(self, gmis: Sequence[GmiStatus]) -> Table:
        grid = Table.grid()
        if self._has_figures:
            done = Text.assemble(bar(self._part()), f"  {self._done()}{self._eta()}")
            grid.add_row(done)
            grid.add_row(Text(self._figures()))
        else:
            grid.add_row(Text(self._phases.text()))
        for gmi in gmis if len(gmis) > 1 else ():
            done_so_far = f", iteration {gmi.iteration}" if gmi.iteration else ""
            grid.add_row(Text(f"GMI {gmi.gmi}: {gmi.state}{done_so_far}", "dim"))
        if self._phases.now != "stopping" and self._has_figures and self._part() == 1:
            grid.add_row(Text("finishing: saving a checkpoint", "dim"))
        return grid

    @property
    def _has_figures(self) -> bool:
        """Whether it trains; a job that is started again has lines of before."""
        return bool(self._line) and self._phases.now not in BEFORE_RUNNING

    def _text(self) -> str:
        return f"{self._done()}  {self._figures()}{self._eta()}"

    def _eta(self) -> str:
        left_s = self._left.seconds(self._num_timesteps)
        return "" if left_s is None else f"  ETA {clock(left_s)}"

    def _part(self) -> float:
        return min(self._line["env_steps"] / self._num_timesteps, 1.0)

    def _done(self) -> str:
        return f"{100 * self._part():.0f} %"

    def _figures(self) -> str:
        line = self._line
        mean = line.get("return")
        evaluated = "" if self._evaluated is None else f"  eval {self._evaluated:.2f}"
        return (
            f"{line['env_steps']:,} steps  {_rates(line)}  "
            f"return {'-' if mean is None else format(mean, '.2f')}{evaluated}"
        )


def _states(gmis: Sequence[GmiStatus]) -> str:
    return ", ".join(f"GMI {gmi.gmi} {gmi.state}" for gmi in gmis)


def _rates(line: dict[str, Any]) -> str:
    """Steps per second; of acting and of learning where other GMIs do the one and the other."""
    if "async/pps" not in line:
        return f"{line['env_steps_per_s']:,.0f} steps/s"
    behind, filled = line["async/staleness_mean"], line["channel/occupancy"]
    return (
        f"PPS {line['async/pps']:,.0f}  TTOP {line['async/ttop']:,.0f}  "
        f"staleness {'-' if behind is None else format(behind, '.1f')}  "
        f"channels {'-' if filled is None else format(filled, '.0%')} full, "
        f"{line['channel/bytes_per_s'] / 1e6:,.0f} MB/s"
    )
