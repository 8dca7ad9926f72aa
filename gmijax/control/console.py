"""Where a command prints, and what it prints before it begins to work.

Nothing that goes wrong with the output may end a job.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final, Literal, TextIO, TypeAlias

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from gmijax.control.output import discard, not_written, why_of
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths
from gmijax.runs.names import nearby

SMALL_TASK: Final = "ball_balance"
"""What two cores of a CPU learn within minutes; other tasks take hours there."""

_DECISIONS = (
    *("template ", "strategy ", "backend ", "intra ", "inter ", "physics.impl ", "sm_percent "),
    *("GPUs ", "nodes "),
)
"""Beginnings of reasons of decisions. Other lines, such as warnings, are always printed."""


class _BestEffortStream:
    """A text stream that is dropped at its first error: `train | head`, a closed terminal."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self.error: str | None = "it is closed" if stream is None else None
        self.encoding = getattr(stream, "encoding", None) or "utf-8"

    def write(self, text: str) -> int:
        """Writes, or does nothing once that has failed."""
        self._try(lambda stream: stream.write(text))
        return len(text)

    def flush(self) -> None:
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
        except (OSError, ValueError) as error:
            self._stream = None
            discard(stream)
            if not isinstance(error, BrokenPipeError):  # Such a reader has read enough.
                self.error = why_of(error)


class UserConsole(Console):
    """Standard output for people.

    Attributes:
      is_verbose: whether the reasons of decisions are printed too.
      opening: a line that comes before all others, and not where there are none.
    """

    is_verbose = False
    opening: str | None = None

    def print(self, *objects: Any, **named: Any) -> None:
        """See `Console`."""
        opening, self.opening = self.opening, None
        if opening is not None:
            super().print(opening)
        super().print(*objects, **named)

    def require_printed(self) -> None:
        """Raises GmijaxError if something could not be printed."""
        if isinstance(self.file, _BestEffortStream) and self.file.error:
            raise not_written(self.file.error)


Show: TypeAlias = bool | Literal["verbose"] | UserConsole
"""Whether a command prints what it does; verbose: also why it decided so; or where it prints."""


def open_console(*, show: Show) -> UserConsole:
    """Where a job prints what the user may read: standard output, or nowhere."""
    if isinstance(show, UserConsole):
        return show
    # Without a standard output (`>&-`) it is None.
    stream: Any = _BestEffortStream(sys.stdout if show else None)
    is_shown_live = stream.isatty() and os.environ.get("TERM") != "dumb"
    console = UserConsole(
        file=stream,
        quiet=not show,
        soft_wrap=True,
        highlight=False,
        # Paths, tasks and errors may look like markup.
        markup=False,
        # FORCE_COLOR makes anything a terminal to Rich, e.g. the pipe of a notebook.
        force_interactive=is_shown_live,
    )
    console.is_verbose = show == "verbose"
    return console


@contextmanager
def doing(console: Console, what: str) -> Iterator[None]:
    """Prints what is done: on a terminal with a clock for as long as it takes, elsewhere once."""
    if not console.is_interactive:
        console.print(what)
        yield
        return
    columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as progress:
        progress.add_task(what, total=None)
        yield


def announce(console: Console, run: RunPaths, plan: Plan, what: str, lines: Sequence[str]) -> None:
    """Prints where a job is, its plan (`what`: the end of that line), and what to know of it.

    Why the plan is so is printed where the user asks for it; `plan.json` has it always.
    """
    console.print(f"run folder: {nearby(run.root)}")
    if plan.layout.num_gmis == 1:
        where = "the CPU" if plan.backend == "cpu" else "one GPU"
        console.print(f"one process on {where}, {plan.num_envs_per_gmi:,} environments")
    else:
        layout = [list(gmis) for gmis in plan.layout.gmis_of_gpu]
        console.print(f"plan: layout {layout}, backend {plan.backend}, {what}")
    print_reasons(console, (*plan.reasons, *lines))


def is_verbose(console: Console) -> bool:
    """Whether the reasons of decisions are printed."""
    return isinstance(console, UserConsole) and console.is_verbose


def print_reasons(console: Console, reasons: Sequence[str]) -> None:
    """Prints sentences about a plan; those of mere decisions only where they are asked for."""
    for reason in dict.fromkeys(reasons):
        if is_verbose(console) or "warning: " in reason or not reason.startswith(_DECISIONS):
            console.print(f"  {reason}")


def print_next(console: Console, *steps: tuple[str, str]) -> None:
    """Ends the output of a command with those to type next, as (what for, command)."""
    for purpose, command in steps:
        console.print(f"\nNext: {purpose}\n  {command}")


def training_of(task: str, *, has_gpu: bool) -> tuple[str, str]:
    """A training as a step for `print_next`; without a GPU that of a task small enough."""
    if has_gpu or task == SMALL_TASK:
        return f"train {task} yourself", f"gmijax train env={task}"
    purpose = f"train one yourself; a CPU learns {SMALL_TASK} within minutes, {task} needs a GPU"
    return purpose, f"gmijax train env={SMALL_TASK}"
