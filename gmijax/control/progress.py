"""What the user sees of a running job: a live panel on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Protocol

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from gmijax.partition.gmi_process import GmiStatus

_LINE_EVERY_S = 5.0
_BAR_WIDTH = 30


class Progress(Protocol):
    """A view of a running job, used as a context manager."""

    def __enter__(self) -> Progress: ...

    def __exit__(self, *exc: Any) -> None: ...

    def update(self, gmis: Sequence[GmiStatus]) -> None:
        """Called about 20 times a second."""
        ...


class LineSource(Protocol):
    """Where the latest line of metrics comes from: `MetricsReader`, or several as one."""

    def latest(self) -> dict[str, Any] | None:
        """The line that came since the last call, None if there is none."""
        ...


class SilentProgress:
    """Shows nothing; for use as a library."""

    def __enter__(self) -> SilentProgress:
        return self

    def __exit__(self, *exc: Any) -> None:
        return None

    def update(self, gmis: Sequence[GmiStatus]) -> None:
        """See `Progress`."""


class ConsoleProgress:
    """Iteration, environment steps per second, return, ETA, and the state of every GMI."""

    def __init__(self, console: Console, metrics: LineSource, num_timesteps: int) -> None:
        self._console = console
        self._metrics = metrics
        self._num_timesteps = num_timesteps
        self._line: dict[str, Any] = {}
        self._first: tuple[float, int] | None = None
        self._shown: tuple[str, int | None] = ("", None)
        self._shown_s = 0.0
        self._is_broken = False
        self._live = Live(console=console, refresh_per_second=4, transient=True)

    def __enter__(self) -> ConsoleProgress:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *exc: Any) -> None:
        if self._console.is_terminal:
            self._live.stop()
        if self._line:
            self._console.print(self._text(), highlight=False)

    def update(self, gmis: Sequence[GmiStatus]) -> None:
        """See `Progress`; what goes wrong with the display must not end the job."""
        if self._is_broken:
            return
        try:
            self._show(gmis)
        except Exception as error:
            self._is_broken = True
            self._console.print(f"no progress from here on: {error!r}", markup=False)

    def _show(self, gmis: Sequence[GmiStatus]) -> None:
        if (line := self._metrics.latest()) is not None:
            self._line = line
            if self._first is None:
                self._first = (time.monotonic(), line["env_steps"])
        if self._console.is_terminal:
            self._live.update(self._panel(gmis))
        else:
            self._print_now_and_then(gmis)

    def _print_now_and_then(self, gmis: Sequence[GmiStatus]) -> None:
        states, steps = _states(gmis), self._line.get("env_steps")
        now = time.monotonic()
        waited = now - self._shown_s > _LINE_EVERY_S
        if states != self._shown[0] or (steps != self._shown[1] and waited):
            text = f"{self._text()}  " if self._line else ""
            self._console.print(f"{text}[{states}]", markup=False, highlight=False, soft_wrap=True)
            self._shown, self._shown_s = (states, steps), now

    def _panel(self, gmis: Sequence[GmiStatus]) -> Table:
        grid = Table.grid()
        done = min(self._line.get("env_steps", 0) / self._num_timesteps, 1.0)
        filled = round(done * _BAR_WIDTH)
        bar = f"[green]{'━' * filled}[/][dim]{'━' * (_BAR_WIDTH - filled)}[/]"
        grid.add_row(f"{bar} {self._text() if self._line else 'starting'}")
        for gmi in gmis:
            state = escape(gmi.state)
            grid.add_row(f"[dim]GMI {gmi.gmi}: {state}, iteration {gmi.iteration}[/]")
        return grid

    def _text(self) -> str:
        line = self._line
        mean = line.get("return")
        return (
            f"{100 * min(line['env_steps'] / self._num_timesteps, 1):.0f} %  "
            f"{line['env_steps']:,} steps  {_rates(line)}  "
            f"return {'-' if mean is None else format(mean, '.2f')}  ETA {self._eta()}"
        )

    def _eta(self) -> str:
        if self._first is None or self._line["env_steps"] <= self._first[1]:
            return "-"
        since_s, steps = self._first
        rate = (self._line["env_steps"] - steps) / (time.monotonic() - since_s)
        left_s = max(0.0, (self._num_timesteps - self._line["env_steps"]) / rate)
        minutes, seconds = divmod(round(left_s), 60)
        return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"


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
        f"{line['channel/bytes_per_s'] / 1e6:,.0f} MB/s, {line['channel/dropped']:,.0f} dropped"
    )
