"""The controller of training: from a configuration to a finished run.

Checks everything that can be checked before anything is started, then makes the run folder,
enters the backend, runs the GMIs, and writes the summary however the job ends.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from gmijax.cluster.cluster_job import ClusterJob
from gmijax.config import TrainConfig
from gmijax.config.schema import require_config, to_dict
from gmijax.control.console import Show, announce, nearby, open_console, print_next
from gmijax.control.decide import JobSpec, decide, with_task
from gmijax.control.films import filmed, find_opengl
from gmijax.control.large_on_cpu import large_on_cpu
from gmijax.control.progress import ConsoleProgress
from gmijax.control.reduced_plan import with_gpus_left, with_nodes_left
from gmijax.control.restarts import Attempts
from gmijax.control.run_folder import (
    begin_again,
    drop_half_written,
    opened,
    record_end,
    started_from,
    what_is_left,
)
from gmijax.control.start_point import (
    StartPoint,
    find_start_point,
    forgotten,
    replay_line,
    require_replay_fits,
)
from gmijax.control.summary import next_steps, train_outcome, train_summary
from gmijax.control.wandb_link import followed, require_wandb
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.partition.plan import Plan
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.compile_times import CompileTime
from gmijax.runs.folder import RunPaths, add_event, read_json, write_json
from gmijax.runs.held import OpenFolder, is_locked
from gmijax.runs.history import MetricsReader, copy_history
from gmijax.runs.result import summary_of
from gmijax.sim import source
from gmijax.supervise.job_kinds import training_kind
from gmijax.supervise.run_gmis import Launch, recorded
from gmijax.supervise.watched_gmi import GmiStatus


class Result(NamedTuple):
    """Result of a training job.

    Attributes:
      run_dir: the run folder.
      summary: the content of its `summary.json`.
    """

    run_dir: Path
    summary: dict[str, Any]


def train(config: TrainConfig, *, show: Show = False) -> Result:
    """Trains a policy in the GMIs of a plan, and returns when all have ended.

    Args:
      config: see `gmijax.compose`.
      show: print the plan, live progress and the outcome; `verbose`: also why the plan is so.

    Raises:
      ConfigError: bad input, before anything was started.
      GmiFailed: a GMI failed, and starting again did not help or would not have; the run folder
        holds the logs and the last checkpoint.
      JobInterrupted: SIGINT, SIGTERM, SIGHUP or SIGUSR1 came; its note has what is left to
        resume.
    """
    started_s = time.monotonic()
    require_config(config, TrainConfig)
    config = with_task(config)
    require_wandb(config)
    start_point = find_start_point(config)
    opengl = None if start_point.is_complete else find_opengl(config)
    console = open_console(show=show)
    if start_point.is_complete and start_point.folder is not None:
        for note in start_point.notes:
            console.print(note)
        return _finished(config, start_point.folder, console)
    if start_point.checkpoint is not None and (notice := source.executed(config.env)):
        console.print(notice)
    with ExitStack() as held:
        cluster, nodes = None, None
        if config.cluster.engine is not None:
            cluster = held.enter_context(ClusterJob(config))
            nodes = cluster.join(start_point.root(config))
        started = started_from(config, start_point.checkpoint, console.print)
        decided = decide(started, console, nodes)
        return _train(decided, start_point, console, cluster, opengl, started_s)


def _train(
    decided: JobSpec[TrainConfig],
    start_point: StartPoint,
    console: Console,
    cluster: ClusterJob | None,
    opengl: str | None,
    started_s: float,
) -> Result:
    config, plan = decided.config, decided.plan
    require_replay_fits(config, plan, start_point.checkpoint)
    with opened(config, start_point) as (run, notes, folder):
        what = (
            f"{plan.num_envs_per_gmi} environments per GMI, template {plan.template}, reduction "
            f"{plan.strategy}"
        )
        lines = (
            *large_on_cpu(config, on_cpu=plan.backend == "cpu"),
            *replay_line(config, plan),
            *notes,
        )
        announce(console, run, plan, what, (*decided.reasons, *lines))
        job = _TrainingJob(decided, run, folder, console, cluster, opengl)
        try:
            job.run_to_the_end(start_point, started_s)
        finally:
            folder.require()  # Whatever else went wrong without it comes from that.
    summary = read_json(run.summary)
    console.print(train_outcome(summary, run))
    if summary["checkpoint"] is not None:
        print_next(console, *next_steps(run))
    return Result(run.root, summary)


class _TrainingJob:
    """A training job that is ready to start."""

    def __init__(
        self,
        decided: JobSpec[TrainConfig],
        run: RunPaths,
        folder: OpenFolder,
        console: Console,
        cluster: ClusterJob | None,
        opengl: str | None,
    ) -> None:
        self._config, self._plan, self._machine, _ = decided
        self._run, self._folder = run, folder
        self._console = console
        self._cluster = cluster
        self._opengl = opengl
        self._attempts = Attempts(
            run,
            self._config.run.max_restarts,
            self._launch_at,
            console.print,
            cluster.run if cluster is not None else None,
            folder.require,
        )

    def run_to_the_end(self, start_point: StartPoint, started_s: float) -> None:
        """Runs it, with restarts; writes the summary however it ends."""
        config, run = self._config, self._run
        new = MetricsReader(run.metrics).new
        compile_time = CompileTime(_programs_of(config, self._plan, self._machine))
        progress = ConsoleProgress(self._console, new, config.num_timesteps, compile_time)

        def record(status: str, plan: Plan) -> None:
            if not self._folder.is_there():
                return
            wall_s = time.monotonic() - started_s
            restarts = [restart._asdict() for restart in self._attempts.restarts]
            record_end(config, plan, run, status, wall_s, restarts)

        def on_tick(gmis: tuple[GmiStatus, ...]) -> None:
            self._folder.require()
            progress.update(gmis)

        write_json(run.plan, self._plan.to_dict())
        # Recorded first, so that the summary is sent too, and filmed before all is sent.
        with (
            followed(config, run, start_point.checkpoint, self._console.print),
            filmed(self._opengl, run, self._console.print),
            recorded(run, partial(what_is_left, config, run), record),
        ):
            self._prepare(start_point)
            with progress:
                self._attempts.run_to_the_end(start_point.checkpoint, on_tick)

    def _prepare(self, start_point: StartPoint) -> None:
        checkpoint = start_point.checkpoint
        if start_point.folder is not None:
            begin_again(self._run, checkpoint)
        elif checkpoint is not None:
            steps = CheckpointMeta.read(checkpoint).env_steps
            copy_history(RunPaths(checkpoint.parents[1]).metrics, self._run.metrics, steps)

    def _launch_at(self, checkpoint: Path | None, attempt: int) -> Launch:
        if attempt:
            self._look_again()
        config = started_from(self._config, checkpoint)
        if attempt and config.run.profile is not None and self._run.profile.exists():
            # A tracer can be what failed, and would fail there again.
            self._console.print(
                f"run.profile={config.run.profile}: not traced again; what there is, is in "
                f"{nearby(self._run.profile)}"
            )
            config = replace(config, run=replace(config.run, profile=None))
        if (lost := forgotten(config, self._plan)) is not None:
            self._console.print(lost)
        write_json(self._run.config, to_dict(config))
        return Launch(
            plan=self._plan,
            machine=self._machine,
            run=self._run,
            kind=training_kind(config),
            timeouts=config.run,
            waits_after_ctrl_c=True,
            on_warning=self._console.print,
        )

    def _look_again(self) -> None:
        """Takes machines as they are after a fault: nodes, GPUs and daemons may be gone."""
        if self._cluster is not None:
            num_nodes, elastic = len(self._plan.nodes), self._config.run.elastic
            nodes = self._cluster.join_again(num_nodes, elastic=elastic)
            self._plan, notes = with_nodes_left(self._config, self._plan, nodes)
        else:
            self._machine = detect_machine()
            left = with_gpus_left(self._config, self._plan, self._machine)
            self._config, self._plan, notes = left
        # Also where nothing has changed: the attempt before may have run with another backend.
        write_json(self._run.plan, self._plan.to_dict())
        for note in notes:
            add_event(self._run.events, "plan", what=note)
            self._console.print(note)


def _programs_of(config: TrainConfig, plan: Plan, machine: Machine) -> dict[str, Any]:
    """What the time to compile a job's programs depends on."""
    parts = {name: to_dict(getattr(config, name)) for name in ("env", "algo", "physics")}
    return {
        **parts,
        "num_envs": config.num_envs,
        "throughput": config.run.measure_throughput,
        "eval": config.eval.every is not None,
        "layout": plan.layout.gmis_of_gpu,
        "template": plan.template,
        "device": "cpu" if plan.backend == "cpu" else machine.gpus[0].name,
    }


def _finished(config: TrainConfig, run: RunPaths, console: Console) -> Result:
    """Result of a run that is complete; writes the summary if it is missing."""
    if not is_locked(run.lock):
        drop_half_written(run)  # The controller may have been killed at the very end.
    summary = summary_of(run)
    if summary.get("status") != "completed":
        data = read_json(run.plan)
        try:
            plan = Plan.from_dict(data)
        except ConfigError as error:
            raise ConfigError(f"{nearby(run.plan)}: {error}") from None
        summary = train_summary(config, plan, run, "completed", 0.0, [])
        write_json(run.summary, summary)
    console.print(f"this run is complete already: {nearby(run.root)}")
    print_next(console, *next_steps(run))
    return Result(run.root, summary)
