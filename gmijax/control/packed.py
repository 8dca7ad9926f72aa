"""The controller of several runs that are one program of one GMI.

Each of them has a run folder as if it had been trained alone, but for the GMI's logs, which are in
a folder of their own. There is one attempt: where the GMI is lost, the sweep starts the runs
again, together or not, as their checkpoints allow.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from gmijax.config import PhysicsConfig, TrainConfig
from gmijax.config.schema import to_dict
from gmijax.control.console import announce, open_console
from gmijax.control.decide import decide
from gmijax.control.progress import ConsoleProgress
from gmijax.control.run_folder import (
    begin_again,
    keep_logs,
    opened,
    record_end,
    started_from,
)
from gmijax.control.start_point import (
    StartPoint,
    find_start_point,
    forgotten,
    replay_line,
    require_replay_fits,
)
from gmijax.control.summary import train_outcome
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths, add_event, read_json, write_json
from gmijax.runs.held import OpenFolder
from gmijax.runs.history import MetricsReader
from gmijax.supervise.job_kinds import MEMBERS_VARIABLE, PACKED
from gmijax.supervise.run_gmis import Launch, recorded, run_gmis
from gmijax.supervise.watched_gmi import GmiStatus


class _Member(NamedTuple):
    """One of the runs."""

    config: TrainConfig
    run: RunPaths
    folder: OpenFolder


def train_packed(configs: Sequence[TrainConfig], folder: Path) -> None:
    """Trains with all configurations at once; returns when all have ended.

    A run whose numbers are no longer finite ends before the others, and has an `error.json`
    then.

    Args:
      configs: they differ in seed, learning rate and run folder alone, and begin at the same step.
      folder: for the files of the GMI.

    Raises:
      ConfigError: bad input, before anything was started.
      GmiFailed: the GMI failed; the runs are saved up to their last checkpoints.
      JobInterrupted: a signal came.
    """
    started_s = time.monotonic()
    start_points = [find_start_point(config) for config in configs]
    console = open_console(show=True)
    config, plan, machine, reasons = decide(configs[0], console)
    for start_point in start_points:
        require_replay_fits(config, plan, start_point.checkpoint)
    gmis = RunPaths(folder)
    with ExitStack() as held:
        notes = [*reasons, *replay_line(config, plan)]
        members: list[_Member] = []
        for own, start_point in zip(configs, start_points, strict=True):
            member, about = _open(own, config.physics, start_point, held)
            members.append(member)
            notes += (*about, *filter(None, [forgotten(member.config, plan)]))
        what = f"{len(members)} runs of {plan.num_envs_per_gmi} environments in one program"
        announce(console, gmis, plan, what, tuple(dict.fromkeys(notes)))
        _prepare(members, plan, gmis)
        roots = json.dumps([str(member.run.root) for member in members])
        launch = Launch(
            plan=plan,
            machine=machine,
            run=gmis,
            kind=PACKED,
            timeouts=config.run,
            waits_after_ctrl_c=True,
            variables={MEMBERS_VARIABLE: roots},
            on_warning=console.print,
        )
        new = partial(_new_lines, [MetricsReader(member.run.metrics) for member in members])
        progress = ConsoleProgress(console, new, config.num_timesteps)

        def on_tick(status: tuple[GmiStatus, ...]) -> None:
            for member in members:
                member.folder.require()
            progress.update(status)

        record = partial(_record, members, started_s)
        with recorded(gmis, lambda: "continue with the same sweep", record), progress:
            run_gmis(launch, on_tick)
        for member in members:
            member.folder.require()
            console.print(train_outcome(read_json(member.run.summary), member.run))


def _open(
    config: TrainConfig, physics: PhysicsConfig, start_point: StartPoint, held: ExitStack
) -> tuple[_Member, Sequence[str]]:
    """One of the runs with its folder, which is held, and what the user should know of it."""
    run, about, folder = held.enter_context(opened(config, start_point))
    if start_point.folder is not None:
        begin_again(run, start_point.checkpoint)
    notes = list(about)
    config = dataclasses.replace(config, physics=physics)
    config = started_from(config, start_point.checkpoint, notes.append)
    return _Member(config, run, folder), notes


def _prepare(members: Sequence[_Member], plan: Plan, gmis: RunPaths) -> None:
    """Writes what the GMI reads when it starts; keeps the logs of the one before."""
    keep_logs(gmis)
    write_json(gmis.plan, plan.to_dict())
    for config, run, _ in members:
        run.gmi(0).root.mkdir(exist_ok=True)
        run.gmi(0).error.unlink(missing_ok=True)
        write_json(run.config, to_dict(config))
        write_json(run.plan, plan.to_dict())
        add_event(run.events, "start", checkpoint=config.run.resume, gmi=str(gmis.gmi(0).root))


def _new_lines(readers: Sequence[MetricsReader]) -> list[dict[str, Any]]:
    """Metrics of all runs, the latest last: one that has diverged writes no more."""
    found = [line for reader in readers for line in reader.new()]
    return sorted(found, key=itemgetter("env_steps"))


def _record(members: Sequence[_Member], started_s: float, status: str, plan: Plan) -> None:
    wall_s = time.monotonic() - started_s
    for config, run, folder in members:
        if not folder.is_there():
            continue  # What is at its path now is another run's.
        write_json(run.plan, plan.to_dict())
        record_end(config, plan, run, _status_of(run, status), wall_s, [])


def _status_of(run: RunPaths, status: str) -> str:
    """How one of the runs has ended, where all together have ended with `status`."""
    if run.gmi(0).error.exists():
        return "failed"
    if run.gmi(0).result.exists() and read_json(run.gmi(0).result)["status"] == "completed":
        return "completed"
    return status
