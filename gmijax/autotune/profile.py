"""One profile of a search: a real short job in child GMIs.

Whatever goes wrong in the job is an answer, not an error.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from typing import Any

from gmijax.autotune.grid import Measured, NotRunnable, Point
from gmijax.autotune.workloads import Workload
from gmijax.clock import running_s
from gmijax.config import Timeouts
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError, GmijaxError, JobInterrupted
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths, write_json
from gmijax.supervise.run_gmis import Launch, OnTick, run_gmis
from gmijax.supervise.watched_gmi import GmiStatus


class ProfileLate(Exception):
    """A profile did not end within its time limit; the message has the progress of its GMIs."""


def profile(
    workload: Workload[Any],
    point: Point,
    machine: Machine,
    run: RunPaths,
    *,
    limit_s: float,
    on_tick: OnTick,
    on_warning: Callable[[str], None],
) -> Measured | NotRunnable:
    """Runs a short job at a point; `run` is its folder, of which logs are kept.

    Raises:
      ProfileLate: it did not end within `limit_s`.
      JobInterrupted: a signal came.
    """
    try:
        plan = workload.plan_at(point, machine)
        config = workload.config_at(point, plan.layout.num_gmis)
    except ConfigError as error:
        return NotRunnable(str(error))
    run.root.mkdir(parents=True, exist_ok=True)
    write_json(run.config, to_dict(config))
    write_json(run.plan, plan.to_dict())
    launch = _launch(workload, plan, machine, run, limit_s, on_warning)
    try:
        run_gmis(launch, _until(limit_s, on_tick))
        return workload.read(plan, run)
    except JobInterrupted:
        raise
    except GmijaxError as error:
        return NotRunnable(" ".join(str(error).split()))
    # All GMIs ended well, and still their results lack what they should have.
    except (OSError, ArithmeticError, LookupError, TypeError, ValueError) as error:
        return NotRunnable(f"no result to read: {type(error).__name__}: {error}")
    finally:
        shutil.rmtree(run.checkpoints, ignore_errors=True)


def _launch(
    workload: Workload[Any],
    plan: Plan,
    machine: Machine,
    run: RunPaths,
    limit_s: float,
    on_warning: Callable[[str], None],
) -> Launch:
    never_s = 2 * limit_s  # The profile's own limit comes before those of its GMIs.
    return Launch(
        plan=plan,
        machine=machine,
        run=run,
        kind=workload.kind,
        timeouts=Timeouts(
            start_timeout_s=never_s, stall_timeout_s=never_s, stop_timeout_s=3.0, grace_s=3.0
        ),
        on_warning=on_warning,
        is_enough=workload.enough(plan, run),
    )


def _until(limit_s: float, on_tick: OnTick) -> OnTick:
    """`on_tick`, which raises ProfileLate once `limit_s` is over."""
    deadline_s = running_s() + limit_s

    def watch(gmis: tuple[GmiStatus, ...]) -> None:
        on_tick(gmis)
        if running_s() > deadline_s:
            states = ", ".join(f"GMI {gmi.gmi} {gmi.state}" for gmi in gmis)
            raise ProfileLate(f"did not end within {limit_s:.0f} s ({states})")

    return watch
