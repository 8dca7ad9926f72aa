"""A search for `num_envs` and `plan.gmis_per_gpu`, by profiling.

The rules are in `gmijax.autotune.search`, a single profile in `gmijax.autotune.profile`. Here
they are combined with the profile store, the time budget and the console.
"""

from __future__ import annotations

import shutil
import time
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from rich.console import Console

from gmijax.autotune.async_workload import A3cWorkload
from gmijax.autotune.grid import Grid, Measured, NotRunnable, Point
from gmijax.autotune.profile import ProfileLate, profile
from gmijax.autotune.report import SearchDisplay, draw, plain_data, table, verdict
from gmijax.autotune.search import OutOfBudget, Rules, SearchOutcome, SearchPoint
from gmijax.autotune.store import ProfileStore
from gmijax.autotune.workloads import (
    VERSIONS,
    C,
    ServeWorkload,
    Split,
    SynchronousWorkload,
    Workload,
)
from gmijax.clock import running_s
from gmijax.config import AUTO, ServeConfig, TrainConfig
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError, GmijaxError, JobInterrupted
from gmijax.machine.snapshot import Machine
from gmijax.partition.backend_choice import candidates, require_num_gpus
from gmijax.partition.layout import Layout
from gmijax.runs.folder import RunPaths, create_run, write_json
from gmijax.runs.names import nearby
from gmijax.sim.impl import choose_impl
from gmijax.version import versions_of

_ORDERS: Final = MappingProxyType(
    {"coarse_first": "gmijax.autotune.search", "as_printed": "gmijax.baselines.algorithm2"}
)
"""Modules whose `search` goes through the grid, by `search.order`."""


class SearchResult(NamedTuple):
    """Result of a search.

    Attributes:
      run_dir: its folder, None where the profile store had everything.
      gmis_per_gpu: GMIs on every GPU; where others train, those that act.
      num_envs: environments per GMI.
      impl: physics implementation.
      reason: why, in words.
      report: the content of `search.json`.
      trainers: training GMIs on every GPU that trains; 0 where every GMI does everything.
      split: how many GPUs act and train, where none does both.
    """

    run_dir: Path | None
    gmis_per_gpu: int
    num_envs: int
    impl: str
    reason: str
    report: dict[str, Any]
    trainers: int = 0
    split: Split | None = None

    @property
    def point(self) -> Point:
        """The best point."""
        return Point(self.gmis_per_gpu, self.num_envs, self.impl, self.trainers)


def workload_of(config: TrainConfig | ServeConfig) -> Workload[Any]:
    """A job as a workload; raises ConfigError for one that cannot be profiled."""
    if isinstance(config, ServeConfig):
        return ServeWorkload(config)
    return A3cWorkload(config) if config.is_decoupled else SynchronousWorkload(config)


def is_auto(config: TrainConfig | ServeConfig) -> bool:
    """Whether something in a job is for a search to find."""
    return AUTO in (config.num_envs, config.plan.gmis_per_gpu)


def with_auto_decided(config: C, machine: Machine, console: Console) -> tuple[C, tuple[str, ...]]:
    """The job with what is `auto` found by a search, and why in words.

    Instant where the profile store has it. What has to be profiled is kept in a folder of its
    own, `runs/<env>-search-<date>-<time>`.

    Raises:
      ConfigError: too few GPUs for the job, before anything is profiled.
      ConfigError, GmijaxError, JobInterrupted: as `Search.result`.
    """
    if not is_auto(config):
        return config, ()
    workload = workload_of(config)
    if workload.platform_on(machine) == "gpu":
        require_num_gpus(workload.plan.num_gpus, candidates(workload.plan, machine))
    found = Search(workload, machine, console).result()
    return workload.settled(found.point, found.split), (found.reason,)


class Search:
    """One search; `run` is its folder, None until something has to be profiled.

    Raises:
      ConfigError: what no point can change: a backend that is not there, too few GPUs.
    """

    def __init__(self, workload: Workload[Any], machine: Machine, console: Console) -> None:
        self.run: RunPaths | None = None
        self._workload = workload
        self._settings = workload.config.search
        self._machine = machine
        self._console = console
        self._grid = grid = _grid(workload, machine)
        fewest = Point(min(grid.gmis_per_gpu), min(grid.num_envs), grid.impls[0], grid.trainers)
        workload.plan_at(fewest, machine)
        key = workload.store_key(machine)
        self._store = ProfileStore(self._settings.store, key, self._console.print)
        self._display = SearchDisplay(console, self._settings.budget_s)
        self._deadline_s = 0.0
        self._num_profiled = 0

    def result(self) -> SearchResult:
        """Searches, writes and prints what was found.

        Raises:
          ConfigError: a budget too small for one profile.
          GmijaxError: no point can run.
          JobInterrupted: a signal came; the profiles so far are kept.
        """
        started_s = time.monotonic()
        self._deadline_s = running_s() + self._settings.budget_s
        try:
            with self._display:
                outcome = self._outcome()
            best = self._require_best(outcome)
        except GmijaxError:
            if self.run is not None and not self._num_profiled:  # There is no log of any.
                shutil.rmtree(self.run.root, ignore_errors=True)
            raise
        assert isinstance(best.result, Measured)
        workload = self._workload
        split = workload.split(best.result)
        reason = verdict(outcome, self._grid, workload.plan.num_gpus, split)
        device, label = workload.device(self._machine), workload.config.env.label
        report = plain_data(outcome, reason, split) | {
            "env": label,
            "device": device,
            "num_gpus": workload.plan.num_gpus,
            "grid": self._grid._asdict(),
            "search": to_dict(self._settings),
            "wall_s": time.monotonic() - started_s,
            "num_profiled": self._num_profiled,
            "store": str(self._store.path),
            "versions": versions_of(VERSIONS),
        }
        self._console.print(table(outcome))
        self._console.print(reason)  # Before the files: the disk may be full.
        if self.run is not None:
            write_json(self.run.search_report, report)
            draw(outcome, self.run.search_png, f"{label}, {device}")
            self._console.print(f"report: {nearby(self.run.search_report)}")
        run_dir = None if self.run is None else self.run.root
        gmis_per_gpu, num_envs, impl, trainers = best.point
        return SearchResult(run_dir, gmis_per_gpu, num_envs, impl, reason, report, trainers, split)

    def _outcome(self) -> SearchOutcome:
        rules = Rules(estimate=self._workload.projected, top=self._workload.top)
        chosen = import_module(_ORDERS[self._settings.order])
        return chosen.search(self._grid, self._profile, rules)

    def _profile(self, point: Point) -> Measured | NotRunnable:
        """Result of a point: from the store, else from a job of its own."""
        try:
            self._workload.plan_at(point, self._machine)
        except ConfigError as error:
            # Not kept: there may be more memory, or another driver, next time.
            refused = NotRunnable(str(error))
            self._display.done(point, refused, 0.0)
            return refused
        limit_s = self._settings.profile_limit_s
        return self._store.kept_or("search", point, lambda: self._measured(point), limit_s)

    def _measured(self, point: Point) -> Measured | NotRunnable:
        """Result of a job of its own."""
        started_s = time.monotonic()
        result = self._run(point)
        self._num_profiled += 1
        self._display.done(point, result, time.monotonic() - started_s)
        return result

    def _run(self, point: Point) -> Measured | NotRunnable:
        left_s = self._deadline_s - running_s()
        if left_s <= 0:
            raise OutOfBudget
        limit_s = min(left_s, self._settings.profile_limit_s)
        if self.run is None:
            self.run = create_run(None, None, f"{self._workload.config.env.slug}-search")
        self._display.begin()
        try:
            return profile(
                self._workload,
                point,
                self._machine,
                self.run.search_profile(f"{point.gmis_key}x{point.num_envs}-{point.impl}"),
                limit_s=limit_s,
                on_tick=lambda gmis: self._display.watch(point, gmis),
                on_warning=self._console.print,
            )
        except ProfileLate as late:
            if limit_s < self._settings.profile_limit_s:
                # Cut off, which is no result of the point.
                raise OutOfBudget from None
            return NotRunnable(str(late), limit_s)
        except JobInterrupted as error:
            error.add_note(f"the same search continues from {nearby(self._store.path)}")
            raise

    def _require_best(self, outcome: SearchOutcome) -> SearchPoint:
        if outcome.best is not None:
            return outcome.best
        if not outcome.visited:
            raise ConfigError(
                f"search.budget_s={self._settings.budget_s:g}: too small for one profile; raise "
                "it, or use smaller sizes in search.num_envs"
            )
        first = outcome.visited[0]
        why = more = ""
        if isinstance(first.result, NotRunnable):
            why = first.result.reason
            if first.result.limit_s is not None:  # It was too slow.
                more = "; raise search.budget_s, or use smaller sizes in search.num_envs"
        root = self.run.root if self.run is not None and self._num_profiled else None
        logs = "" if root is None else f" (logs: {nearby(root)})"
        raise GmijaxError(
            f"no point of the search can run; the first, {first.point}: {why}{more}{logs}"
        )


def _grid(workload: Workload[Any], machine: Machine) -> Grid:
    plan, config = workload.plan, workload.config
    settings = config.search
    gmis: tuple[int, ...] = settings.gmis_per_gpu
    if plan.layout is not None:
        gmis = (max(len(here) for here in Layout(plan.layout).gmis_of_gpu),)
    elif plan.gmis_per_gpu != AUTO:
        gmis = (plan.gmis_per_gpu,)
    num_envs = settings.num_envs if config.num_envs == AUTO else (config.num_envs,)
    impl = config.physics.impl
    if impl == AUTO and settings.impls:
        return Grid(gmis, num_envs, settings.impls, workload.trainers)
    impl, _ = choose_impl(impl, workload.platform_on(machine), config.env.label)
    return Grid(gmis, num_envs, (impl,), workload.trainers)
