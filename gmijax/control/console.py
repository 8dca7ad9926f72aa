"""What the user sees of a running job: a live panel on a terminal, plain lines elsewhere.

Nothing that goes wrong with the output may end the job. No jax here.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gmijax.control.display import LiveDisplay, bar, clock
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths
from gmijax.supervise.watched_gmi import GmiStatus

_LINE_EVERY_S = 5.0

_OF_SEVERAL = ("template ", "strategy ", "backend cpu: no usable NVIDIA GPU here")
"""Beginnings of reasons that mean nothing where there is one GMI."""

_COMPILING = "compiling: once for each task and size, usually 1 to 3 minutes"


class _BestEffortStream:
    """A text stream that is dropped at its first error: `train | head`, a closed terminal."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self.encoding = getattr(stream, "encoding", None) or "utf-8"

    def write(self, text: str) -> int:
        """Writes, or does nothing once that has failed."""
        self._try(lambda stream: stream.write(text))
        return len(text)

    def flush(self) -> None:
        """See `write`."""
        self._try(lambda stream: stream.flush())

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        with suppress(OSError, ValueError):
            return self._stream is not None and self._stream.isatty()
        return False

    def _try(self, act: Callable[[TextIO], object]) -> None:
        stream = self._stream
        if stream is None:
            return
        try:
            act(stream)
        except (OSError, ValueError):
            self._stream = None
            # What is left in its buffer would fail once more when Python ends.
            with suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, stream.fileno())
                os.close(nowhere)


def open_console(*, show: bool) -> Console:
    """Where a job prints what the user may read: standard output, or nowhere."""
    # Without a standard output (`>&-`) it is None.
    stream: Any = _BestEffortStream(sys.stdout if show else None)
    # Paths, tasks and errors may look like markup.
    is_shown_live = stream.isatty() and os.environ.get("TERM") != "dumb"
    return Console(
        file=stream,
        quiet=not show,
        soft_wrap=True,
        highlight=False,
        markup=False,
        # FORCE_COLOR makes anything a terminal to Rich, e.g. the pipe of a notebook.
        force_interactive=is_shown_live,
    )


@contextmanager
def doing(console: Console, what: str) -> Iterator[None]:
    """Says what is done, on a terminal for as long as it takes, elsewhere in a line."""
    if console.is_interactive:
        with console.status(what):
            yield
    else:
        console.print(what)
        yield


def announce(console: Console, run: RunPaths, plan: Plan, what: str, lines: Sequence[str]) -> None:
    """Prints where a job is, its plan (`what`: the end of that line), and why it is so.

    Of one GMI alone nothing is said that only several differ in; `plan.json` has it.
    """
    console.print(f"run folder: {nearby(run.root)}")
    reasons = plan.reasons
    if plan.layout.num_gmis == 1:
        where = "the CPU" if plan.backend == "cpu" else "one GPU"
        console.print(f"one process on {where}, {plan.num_envs_per_gmi:,} environments")
        reasons = tuple(text for text in reasons if not text.startswith(_OF_SEVERAL))
    else:
        layout = [list(gmis) for gmis in plan.layout.gmis_of_gpu]
        console.print(f"plan: layout {layout}, backend {plan.backend}, {what}")
    for line in (*reasons, *lines):
        console.print(f"  {line}")


def nearby(path: Path) -> str:
    """A path as it is typed from the working directory, if that is shorter."""
    with suppress(ValueError, OSError):
        return str(path.relative_to(Path.cwd()))
    return str(path)


class ConsoleProgress:
    """Iteration, environment steps per second, return, ETA, and the state of every GMI.

    Args:
      console: nothing is shown on a quiet one.
      new: the lines of metrics that came since the last call.
      num_timesteps: environment steps of the whole job.
    """

    def __init__(
        self,
        console: Console,
        new: Callable[[], Sequence[dict[str, Any]]],
        num_timesteps: int,
    ) -> None:
        self._console = console
        self._new = new
        self._num_timesteps = num_timesteps
        self._line: dict[str, Any] = {}
        self._evaluated: float | None = None
        self._first: tuple[float, int] | None = None
        self._shown: tuple[str, int | None] = ("", None)
        self._shown_s = 0.0
        self._began_s = time.monotonic()
        self._display = LiveDisplay(console)

    def __enter__(self) -> ConsoleProgress:
        self._display.__enter__()
        return self

    def __exit__(self, *exc: Any) -> None:
        self._display.__exit__(*exc)
        # A panel is gone then; what a line has said is not said again.
        if self._line and (self._display.has_panel or self._line["env_steps"] != self._shown[1]):
            self._console.print(self._text())

    def update(self, gmis: Sequence[GmiStatus]) -> None:
        """Called about 20 times a second."""
        self._display.show(lambda: self._show(gmis))

    def _show(self, gmis: Sequence[GmiStatus]) -> Table | None:
        for line in self._new():
            self._line = line
            self._evaluated = line.get("eval/return", self._evaluated)
            if self._first is None:
                self._first = (time.monotonic(), line["env_steps"])
        if self._display.has_panel:
            return self._panel(gmis)
        self._print_now_and_then(gmis)
        return None

    def _print_now_and_then(self, gmis: Sequence[GmiStatus]) -> None:
        states, steps = _states(gmis), self._line.get("env_steps")
        now = time.monotonic()
        waited = now - self._shown_s > _LINE_EVERY_S
        if states != self._shown[0] or (steps != self._shown[1] and waited):
            text = f"{self._text()}  " if self._line else ""
            if not self._line and _are_compiling(gmis):
                text = f"{_COMPILING}  "
            self._console.print(f"{text}[{states}]")
            self._shown, self._shown_s = (states, steps), now

    def _panel(self, gmis: Sequence[GmiStatus]) -> Table:
        grid = Table.grid()
        done = min(self._line.get("env_steps", 0) / self._num_timesteps, 1.0)
        text = self._text() if self._line else self._waiting(gmis)
        grid.add_row(Text.assemble(bar(done), f" {text}"))
        for gmi in gmis:
            done_so_far = f", iteration {gmi.iteration}" if gmi.iteration else ""
            grid.add_row(Text(f"GMI {gmi.gmi}: {gmi.state}{done_so_far}", "dim"))
        return grid

    def _waiting(self, gmis: Sequence[GmiStatus]) -> str:
        """What is done before the first iteration, and for how long."""
        what = _COMPILING if _are_compiling(gmis) else "starting"
        return f"{what}  {clock(time.monotonic() - self._began_s)}"

    def _text(self) -> str:
        line = self._line
        mean = line.get("return")
        evaluated = "" if self._evaluated is None else f"eval {self._evaluated:.2f}  "
        return (
            f"{100 * min(line['env_steps'] / self._num_timesteps, 1):.0f} %  "
            f"{line['env_steps']:,} steps  {_rates(line)}  "
            f"return {'-' if mean is None else format(mean, '.2f')}  {evaluated}"
            f"ETA {self._eta()}"
        )

    def _eta(self) -> str:
        if self._first is None or self._line["env_steps"] <= self._first[1]:
            return "-"
        since_s, steps = self._first
        rate = (self._line["env_steps"] - steps) / (time.monotonic() - since_s)
        return clock(max(0.0, (self._num_timesteps - self._line["env_steps"]) / rate))


def _are_compiling(gmis: Sequence[GmiStatus]) -> bool:
    return any(gmi.state == "compiling" for gmi in gmis)


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
