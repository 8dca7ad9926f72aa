"""Starts the GMIs of a plan and watches them to their end, with all that they share.

What GMIs share is made here and gone when `run_gmis` returns: blocks of memory without a name,
and the backend with its daemons. The processes themselves are `gmijax.supervise.supervisor`'s.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager

from gmijax.collectives.host.shared_block import create_exchange
from gmijax.errors import BackendUnavailable, ConfigError, FolderLost, GmijaxError, JobInterrupted
from gmijax.partition.backend_choice import WHAT_SHARE_LOSES
from gmijax.partition.plan import Plan
from gmijax.runs.cache import drop_broken_programs
from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.runs.names import nearby
from gmijax.supervise.backends import Backend, open_backend
from gmijax.supervise.child import ENV_EXCHANGE_FD
from gmijax.supervise.job_kinds import JobKind
from gmijax.supervise.start_gmi import Launch, program_cache
from gmijax.supervise.stop_signals import StopSignals, stop_signals
from gmijax.supervise.supervisor import Supervisor
from gmijax.supervise.watched_gmi import GmiStatus

OnTick = Callable[[tuple[GmiStatus, ...]], None]


def run_gmis(
    launch: Launch, on_tick: OnTick | None = None, signals: StopSignals | None = None
) -> None:
    """Runs all GMIs to their end; calls `on_tick` about 20 times a second.

    Args:
      launch: what to run.
      on_tick: see above.
      signals: those that the caller handles already; None: this handles them while it runs.

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

        try:
            Supervisor(launch, backend, inherited, signals=signals).run(on_tick)
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
    except (FolderLost, ConfigError):
        raise  # What is wrong with the input is in the message alone.
    except GmijaxError as error:
        error.add_note(f"run folder: {nearby(run.root)}")
        raise
    finally:
        try:
            record(status, Plan.from_dict(read_json(run.plan)))  # Its backend may be another.
        except (OSError, ConfigError) as error:
            # A full disk must not hide why a job failed; nor may what is not written be read.
            if status == "completed":
                why = getattr(error, "strerror", None) or error
                where = nearby(run.root)
                raise GmijaxError(f"the outcome cannot be written to {where} ({why})") from None


def _enter_backend(held: ExitStack, launch: Launch) -> tuple[Launch, Backend]:
    """Enters the plan's backend, or `share`, with a note in the plan, where the plan allows it.

    Whether daemons may be started here (rights, another user's daemon) shows only when it is
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
