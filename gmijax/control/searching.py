"""The controller of searches: `num_envs` and `plan.gmis_per_gpu` by profiling. No jax here.

The rules are in `gmijax.partition.search`, a single profile in `gmijax.control.profiling`. Here
they meet the profile store, the time budget and the console.
"""

from __future__ import annotations

import dataclasses
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from gmijax.config import AUTO, SearchConfig, TrainConfig
from gmijax.control.async_search import decoupled_training
from gmijax.control.decoupled import is_decoupled
from gmijax.control.output import open_console
from gmijax.control.profiles import ProfileStore, default_folder
from gmijax.control.profiling import (
    Mode,
    ProfileLate,
    device_of,
    installed_versions,
    plan_at,
    platform_of,
    profile,
    store_key,
)
from gmijax.control.search_report import (
    SearchDisplay,
    SearchPaths,
    draw,
    plain_data,
    table,
    verdict,
)
from gmijax.control.workload import Workload, training
from gmijax.errors import ConfigError, GmijaxError, JobInterrupted
from gmijax.partition.balance import Split
from gmijax.partition.grid import Grid
from gmijax.partition.layout import Layout
from gmijax.partition.machine import Machine, detect_machine
from gmijax.partition.points import Measured, NotRunnable, Point
from gmijax.partition.search import Outcome, OutOfBudget, Rules, Visited
from gmijax.partition.search import search as search_grid
from gmijax.rundir import RunPaths, create_run, write_json
from gmijax.schema import to_dict
from gmijax.sim import source
from gmijax.sim.impl import choose_impl
from gmijax.sim.registry import require_task


class SearchResult(NamedTuple):
    """What a search leaves.

    Attributes:
      run_dir: its folder, None where a job needed only what the profile store had.
      gmis_per_gpu: GMIs on every GPU.
      num_envs: environments per GMI.
      impl: physics implementation.
      reason: why, in words.
      report: the content of `search.json`.
      trainers: training GMIs on every GPU that trains, and then `gmis_per_gpu` are those that act;
        0 where every GMI does everything.
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


def search(config: TrainConfig, *, show: bool = False) -> SearchResult:
    """Finds environments per GMI and GMIs per GPU for a training job, where they are `auto`.

    Args:
      config: see `gmijax.compose(..., command="search")`; its `search` says how.
      show: print progress, a table and the answer.

    Raises:
      ConfigError: bad input, before anything was started, or a budget too small for one profile.
      GmijaxError: no point can run.
      JobInterrupted: SIGINT, SIGTERM or SIGHUP came; the profiles so far are kept.
    """
    if config.run.resume is not None:
        raise ConfigError(
            f"run.resume={config.run.resume}: not for a search, which goes on by itself from "
            "what search.store has"
        )
    if not is_auto(config):
        raise ConfigError(
            f"num_envs={config.num_envs}, plan.gmis_per_gpu={config.plan.gmis_per_gpu}: nothing "
            "to search for; make one of them auto"
        )
    require_task(str(config.env.name), config.env.suite)
    config = dataclasses.replace(config, env=source.pinned(config.env))
    console = open_console(show=show)
    started = _Search(workload_of(config), config.search, detect_machine(), console)
    # After everything else was checked: nothing is left of a search that was refused.
    started.run = create_run(config.run.dir, config.run.name, f"{config.env.slug}-search")
    write_json(started.run.config, to_dict(config))
    console.print(f"run folder: {started.run.root}", markup=False)
    return started.result()


def workload_of(config: TrainConfig) -> Workload:
    """A training job as a workload.

    Raises:
      ConfigError: one that cannot be profiled.
    """
    return decoupled_training(config) if is_decoupled(config) else training(config)


def is_auto(config: TrainConfig) -> bool:
    """Whether something in a training job is for a search to find."""
    return AUTO in (config.num_envs, config.plan.gmis_per_gpu)


def resolve_auto(
    workload: Workload, settings: SearchConfig, machine: Machine, console: Console
) -> SearchResult:
    """Finds what is `auto` in a job, for any command; instant where the profile store has it.

    What has to be profiled is kept in a folder of its own, `runs/<env>-search-<date>-<time>`.

    Args:
      workload: the job.
      settings: how to search.
      machine: where this is.
      console: told about the search.

    Raises:
      ConfigError, GmijaxError, JobInterrupted: as `search`.
    """
    return _Search(workload, settings, machine, console).result()


class _Search:
    """One search; see `resolve_auto`.

    Attributes:
      run: its folder, None until something has to be profiled.
    """

    def __init__(
        self, workload: Workload, settings: SearchConfig, machine: Machine, console: Console
    ) -> None:
        self.run: RunPaths | None = None
        self._workload = workload
        self._settings = settings
        self._machine = machine
        self._console = console
        self._grid = _grid(workload, settings, machine)
        # Refuses what no point can change: a backend that is not there, too few GPUs.
        fewest = Point(
            min(self._grid.gmis_per_gpu),
            min(self._grid.num_envs),
            self._grid.impls[0],
            min(self._grid.trainers),
        )
        plan_at(workload, fewest, "corun", machine)
        self._device = device_of(workload, machine)
        folder = Path(settings.store) if settings.store else default_folder()
        self._store = ProfileStore(folder, store_key(workload, machine), self._note)
        self._display = SearchDisplay(console, settings.budget_s)
        self._deadline_s = 0.0
        self._isolated: dict[Point, Measured | NotRunnable] = {}
        self._num_profiled = 0

    def result(self) -> SearchResult:
        """Searches, writes and prints what was found."""
        started_s = time.monotonic()
        self._deadline_s = started_s + self._settings.budget_s
        with self._display:
            outcome = self._outcome()
        best = self._require_best(outcome)
        assert isinstance(best.result, Measured)
        split = self._workload.split(best.result)
        reason = verdict(outcome, self._grid, self._workload.num_gpus, split)
        report = plain_data(outcome, self._isolated, reason, split) | {
            "env": self._workload.env.label,
            "device": self._device,
            "num_gpus": self._workload.num_gpus,
            "grid": self._grid._asdict(),
            "search": to_dict(self._settings),
            "wall_s": time.monotonic() - started_s,
            "num_profiled": self._num_profiled,
            "store": str(self._store.path),
            "versions": installed_versions(),
        }
        self._console.print(table(outcome, self._isolated))
        if self.run is not None:
            paths = SearchPaths(self.run.root)
            write_json(paths.report, report)
            draw(outcome, paths.picture, f"{self._workload.env.label}, {self._device}")
            self._note(f"report: {paths.report}")
        self._note(reason)
        run_dir = None if self.run is None else self.run.root
        gmis_per_gpu, num_envs, impl, trainers = best.point
        return SearchResult(run_dir, gmis_per_gpu, num_envs, impl, reason, report, trainers, split)

    def _outcome(self) -> Outcome:
        settings = self._settings
        mode: Mode = "isolated" if settings.mode == "isolated" else "corun"
        rules = Rules(
            estimate=self._workload.projected,
            alpha=settings.alpha,
            tolerance=settings.tolerance,
            coarse_first=settings.order == "coarse_first",
            top=self._workload.top,
        )
        outcome = search_grid(self._grid, lambda point: self._profile(point, mode), rules)
        if settings.mode == "both":
            with suppress(OutOfBudget):
                for one in sorted(outcome.visited, key=lambda one: -one.projected):
                    if isinstance(one.result, Measured) and one.point.gmis_per_gpu > 1:
                        self._isolated[one.point] = self._profile(one.point, "isolated")
        return outcome

    def _profile(self, point: Point, mode: Mode) -> Measured | NotRunnable:
        """What a point did: from the store, else from a job of its own."""
        try:
            plan_at(self._workload, point, mode, self._machine)
        except ConfigError as error:
            # Not kept: there may be more room, or another driver, next time.
            refused = NotRunnable(str(error))
            self._display.done(f"{point} ({mode})", point, refused, 0.0)
            return refused
        known = self._store.get(mode, point)
        if known is not None and not self._may_end_now(known):
            return known
        left_s = self._deadline_s - time.monotonic()
        if left_s <= 0:
            raise OutOfBudget
        limit_s = min(left_s, self._settings.profile_timeout_s)
        if self.run is None:
            self.run = create_run(None, None, f"{self._workload.env.slug}-search")
        gmis = point.gmis.replace(" ", "")
        folder = f"{mode}-{gmis}x{point.num_envs}-{point.impl}"
        started_s = time.monotonic()
        try:
            result = profile(
                self._workload,
                point,
                mode,
                self._machine,
                RunPaths(SearchPaths(self.run.root).profiles / folder),
                limit_s=limit_s,
                on_tick=lambda gmis: self._display.watch(f"{point} ({mode})", gmis),
                on_warning=self._note,
            )
        except ProfileLate as late:
            if limit_s < self._settings.profile_timeout_s:
                # Cut off, which says nothing about the point.
                raise OutOfBudget from None
            result = NotRunnable(str(late), limit_s)
        except JobInterrupted as error:
            error.add_note(f"the same search goes on from {self._store.path}")
            raise
        wall_s = time.monotonic() - started_s
        self._num_profiled += 1
        self._store.put(mode, point, result, wall_s)
        self._display.done(f"{point} ({mode})", point, result, wall_s)
        return result

    def _may_end_now(self, known: Measured | NotRunnable) -> bool:
        """Whether a point was late, and is given more time now."""
        limit_s = known.limit_s if isinstance(known, NotRunnable) else None
        return limit_s is not None and limit_s < self._settings.profile_timeout_s

    def _require_best(self, outcome: Outcome) -> Visited:
        if outcome.best is not None:
            return outcome.best
        if not outcome.visited:
            raise ConfigError(
                f"search.budget_s={self._settings.budget_s:g}: too small for one profile; the "
                "first was cut off"
            )
        first = outcome.visited[0]
        why = first.result.reason if isinstance(first.result, NotRunnable) else ""
        raise GmijaxError(f"no point of the search can run; the first, {first.point}: {why}")

    def _note(self, text: str) -> None:
        self._console.print(text, markup=False)


def _grid(workload: Workload, settings: SearchConfig, machine: Machine) -> Grid:
    plan = workload.plan
    gmis: tuple[int, ...] = settings.gmis_per_gpu
    if plan.layout is not None:
        gmis = (max(len(here) for here in Layout(plan.layout).gmis_of_gpu),)
    elif plan.gmis_per_gpu != "auto":
        gmis = (plan.gmis_per_gpu,)
    num_envs = settings.num_envs if workload.num_envs == "auto" else (workload.num_envs,)
    if workload.impl == "auto" and settings.impls:
        return Grid(gmis, num_envs, settings.impls, workload.trainers)
    impl, _ = choose_impl(workload.impl, platform_of(workload, machine), workload.env.label)
    return Grid(gmis, num_envs, (impl,), workload.trainers)
