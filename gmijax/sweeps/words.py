"""What a sweep prints before its first job and after its last one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from gmijax.config.sweep import Ranking
from gmijax.control.console import nearby, print_reasons
from gmijax.runs.names import counted
from gmijax.sweeps.any_job import J
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.report import tables
from gmijax.sweeps.slots import Site
from gmijax.sweeps.work import Work


def announce(
    console: Console,
    sites: Sequence[Site],
    work: Work[J],
    num_complete: int,
) -> None:
    """Prints how many jobs there are, how many are complete, and where they run.

    Args:
      console: where it is printed.
      sites: machines and their slots.
      work: the jobs, and where they come from.
      num_complete: jobs that an earlier command has completed.
    """
    settings = work.settings
    total = len(work.jobs) if settings.sampler == "grid" else settings.trials or 0
    more = f", {num_complete} of them complete already" if num_complete else ""
    slots = sum(len(site.plan.allocations) for site in sites)
    at_once = f"at most {slots}" if work.is_adaptive and sites[0].machine.gpus else str(slots)
    console.print(f"{counted(total, 'job')}{more}, {at_once} at a time {_where(sites)}")
    print_reasons(console, [reason for site in sites for reason in site.plan.reasons])
    if work.words and total == 1 and not work.space and settings.sampler == "grid":
        console.print("  one job, because no key has several values; KEY=A,B makes a job of each")
    for warning in work.warnings(sites):
        console.print(f"  {warning}")


def print_outcome(
    console: Console,
    report: Mapping[str, Any],
    ranking: Ranking,
    paths: SweepPaths,
    line: str,
    hint: str,
) -> None:
    """Prints the tables of a `sweep.json`, a hint, a line about all jobs, and the files."""
    for table in tables(report, ranking):
        console.print(table)
        console.print()
    if hint:
        console.print(hint)
    console.print(f"{line}\nsummary: {nearby(paths.sweep)}")
    console.print(f"tables: {nearby(paths.settings)}, {nearby(paths.table)}")
    if paths.curves.exists():
        console.print(f"curves: {nearby(paths.curves)}")


def _where(sites: Sequence[Site]) -> str:
    """Where jobs run, in words."""
    names = [site.name for site in sites if site.name]
    nodes = f" of {counted(len(names), 'node')} ({', '.join(names)})" if names else ""
    backend = sites[0].plan.backend
    if backend == "cpu":
        return f"on the CPU{nodes}"
    num_gpus = sum(site.plan.layout.num_gpus for site in sites)
    return f"on {counted(num_gpus, 'GPU')}{nodes}, backend {backend}"
