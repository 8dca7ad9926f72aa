"""Starts the GMIs of a plan and watches them to their end, with all that they share.

What GMIs share is made here and gone when `run_gmis` returns: blocks of memory without a name,
and the backend with its daemons. The processes themselves are `gmijax.supervise.supervisor`'s.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Final

from gmijax.collectives.host.shared_block import create_exchange
from gmijax.errors import BackendUnavailable, ConfigError, FolderLost, GmijaxError, JobInterrupted
from gmijax.partition.backend_choice import WHAT_SHARE_LOSES
from gmijax.partition.plan import Plan
from gmijax.runs.cache import drop_broken_programs
from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.supervise.backends import Backend, open_backend
from gmijax.supervise.child import ENV_EXCHANGE_FD
from gmijax.supervise.job_kinds import JobKind
from gmijax.supervise.start_gmi import Launch, program_cache
from gmijax.supervise.supervisor import Supervisor
from gmijax.supervise.watched_gmi import GmiStatus

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
"""What asks a job to save and end: Ctrl-C, batch systems, a terminal that is closed."""

_AGAIN_S = 1.0

OnTick = Callable[[tuple[GmiStatus, ...]], None]


def run_gmis(
    launch: Launch, on_tick: OnTick | None = None, signals: StopSignals | None = None
) -> None:
    """Runs all GMIs to their end; calls `on_tick` about 20 times a second.

    Args:
      launch: what to run.
      on_tick: see above.
      signals: those that the caller hears already; None: heard while this runs.

    Raises:
      GmiFailed: a GMI failed; names the first one.
      ConfigError: a GMI rejected its input.
      JobInterrupted: a signal came, and every GMI has ended.
    """
    plan = launch.plan
    with ExitStack() as held:
        # First, so that it ends last: a signal must not cut off the end of the backend.
        if launch.stops_gracefully and signals is None:
            signals = held.enter_context(stop_signals())
        inherited = shared_blocks(held, launch.kind, plan)
        launch, backend = _enter_backend(held, launch)

        supervisor = Supervisor(launch, backend, inherited)
        if signals is not None:
            signals.forward_to(supervisor.request_stop)
        try:
            supervisor.run(on_tick)
        finally:
            drop_unreadable(launch.run, plan.layout.gmis)


def drop_unreadable(run: RunPaths, gmis: Iterable[int]) -> None:
    """Removes programs from this machine's cache that one of the GMIs could not read."""
    drop_broken_programs(program_cache(), [run.gmi(gmi).stderr for gmi in gmis])


def shared_blocks(held: ExitStack, kind: JobKind, plan: Plan) -> dict[str, int]:
    """Descriptors of the memory that the GMIs share, by the variable that names each."""
    opened: dict[str, int] = {}
    blocks = dict(kind.shared(plan))
    if plan.layout.num_gmis > 1:
        blocks[ENV_EXCHANGE_FD] = create_exchange
    for name, create in blocks.items():
        opened[name] = create()
        held.callback(os.close, opened[name])
    return opened


@contextmanager
def recorded(
    run: RunPaths, what_is_left: Callable[[], str], record: Callable[[str, Plan], None]
) -> Iterator[None]:
    """A job of whose end a record is made, however it ends; errors get notes.

    Args:
      run: the run folder.
      what_is_left: in words, for a job that was interrupted.
      record: gets `completed`, `interrupted` or `failed`, and the plan as it was run.

    Raises:
      GmijaxError: the job is complete, and the record cannot be written.
    """
    status = "failed"
    try:
        yield
        status = "completed"
    except JobInterrupted as error:
        status = "interrupted"
        error.add_note(what_is_left())
        raise
    except FolderLost:
        raise
    except GmijaxError as error:
        error.add_note(f"run folder: {run.root}")
        raise
    finally:
        try:
            record(status, Plan.from_dict(read_json(run.plan)))  # Its backend may be another.
        except (OSError, ConfigError) as error:
            # A full disk must not hide why a job failed; nor may what is not written be read.
            if status == "completed":
                why = getattr(error, "strerror", None) or error
                raise GmijaxError(f"the outcome cannot be written to {run.root} ({why})") from None


def _enter_backend(held: ExitStack, launch: Launch) -> tuple[Launch, Backend]:
    """Enters the plan's backend, or `share` where the plan allows it and says so afterwards.

    Whether daemons may be started here (rights, somebody else's daemon) shows only when it is
    tried.
    """
    plan, machine, run = launch.plan, launch.machine, launch.run
    try:
        return launch, held.enter_context(open_backend(plan, machine, run))
    except BackendUnavailable as error:
        launch = taking_turns(launch, error)
    return launch, held.enter_context(open_backend(launch.plan, machine, run))


def taking_turns(launch: Launch, error: BackendUnavailable) -> Launch:
    """The job with the backend `share`, in its `plan.json` too; raises `error` if it may not."""
    plan = launch.plan
    if not plan.allow_fallback:
        raise error
    warning = f"backend share: warning: {error}; so {WHAT_SHARE_LOSES}"
    launch.on_warning(warning)
    plan = dataclasses.replace(
        plan, backend="share", allow_fallback=False, reasons=(*plan.reasons, warning)
    )
    write_json(launch.run.plan, plan.to_dict())
    return dataclasses.replace(launch, plan=plan)


class StopSignals:
    """Signals that ask for an end: the first one, and the same one again a second later or more.

    A program such as `timeout` sends its signal twice at once, and a batch system sends others
    before the last: that is no impatience.

    Attributes:
      requests: how many have come that count.
    """

    def __init__(self) -> None:
        self.requests = 0
        self._last_s: dict[int, float] = {}
        self._forward: Callable[[], None] | None = None

    @property
    def have_come(self) -> bool:
        """Whether an end was asked for."""
        return self.requests > 0

    def handle(self, number: int, _: FrameType | None = None) -> None:
        """The signal handler."""
        now_s = time.monotonic()
        is_again = now_s - self._last_s.get(number, now_s) >= _AGAIN_S
        if is_again or not self._last_s:
            self.requests += 1
            if self._forward is not None:
                self._forward()
        self._last_s[number] = now_s

    def forward_to(self, request_stop: Callable[[], None]) -> None:
        """Forwards requests, also those that have come before."""
        self._forward = request_stop
        for _ in range(self.requests):
            request_stop()


@contextmanager
def stop_signals() -> Iterator[StopSignals]:
    """Hears `STOP_SIGNALS` in place of whatever they did."""
    signals = StopSignals()
    # Python delivers signals to the main thread only; elsewhere they are the caller's business.
    is_main = threading.current_thread() is threading.main_thread()
    # What was ignored when the job was started, by nohup for one, stays ignored.
    previous = {
        number: signal.signal(number, signals.handle)
        for number in STOP_SIGNALS
        if is_main and signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield signals
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
