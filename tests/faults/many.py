"""Many faults, drawn from a seed: `python -m tests.faults.many --faults 200 --out F.json`.

With `--minutes` jobs are drawn from fresh seeds until the time is over. Each job has about five
faults; its folder is kept if anything about it was wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

_TESTS = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(_TESTS), str(_TESTS / "faults")]
import conftest  # noqa: E402, F401 - the environment of jax, before anything loads it

# isort: split
from fault_jobs import Report, kinds_here, run_job, undisturbed  # noqa: E402
from fault_plan import KINDS, Fault, draw_jobs  # noqa: E402

COLUMNS = ("injected", "as wanted", "unexpected", "leaks", "lost checkpoints", "not bit-equal")


def main(argv: Sequence[str]) -> int:
    """Runs jobs and prints a table; 1 if anything was wrong."""
    options = _options(argv)
    options.commit = _said("git", "rev-parse", "HEAD")
    folder = Path(tempfile.mkdtemp(prefix="faults-"))
    started_s = time.monotonic()
    expected = undisturbed(folder / "undisturbed")
    reports: list[tuple[int, Report]] = []

    def run(numbered: tuple[int, tuple[int, list[Fault]]]) -> None:
        number, (seed, faults) = numbered
        if options.minutes and time.monotonic() - started_s > 60 * options.minutes:
            return
        cwd = folder / f"job_{number}"
        report = run_job(faults, cwd, expected)
        reports.append((seed, report))
        if report.is_good:
            shutil.rmtree(cwd)
        kinds = ", ".join(f"{fault.kind} at {fault.iteration}" for fault in faults)
        _print(f"job {number}, seed {seed}: {'good' if report.is_good else 'BAD'} "
               f"({report.seconds:.0f} s): {kinds}")  # fmt: skip
        if not report.is_good:
            _print(f"  {cwd}: {report}")
        if options.out:
            options.out.write_text(json.dumps(_results(options, reports, started_s), indent=1))

    with ThreadPoolExecutor(options.jobs) as pool:
        for _ in pool.map(run, enumerate(_jobs(options))):
            pass
    results = _results(options, reports, started_s)
    _print(_table(results["kinds"]))
    is_good = all(report.is_good for _, report in reports)
    if is_good:
        shutil.rmtree(folder)
    return 0 if is_good else 1


def _options(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("tests.faults.many", description=__doc__)
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--minutes", type=float, help="in place of a number of faults")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="at the same time")
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS), help="only these")
    parser.add_argument("--out", type=Path)
    return parser.parse_args(argv)


def _jobs(options: argparse.Namespace) -> Iterator[tuple[int, list[Fault]]]:
    """Jobs, each with the seed of its deck."""
    kinds = options.kinds or kinds_here()
    if not options.minutes:
        for faults in draw_jobs(options.seed, options.faults, kinds):
            yield options.seed, faults
        return
    # As many as no machine does in that time.
    first = int(time.time())
    for seed in range(first, first + 1 + int(options.minutes)):
        for faults in draw_jobs(seed, len(kinds), kinds):
            yield seed, faults


def _results(
    options: argparse.Namespace, reports: Sequence[tuple[int, Report]], started_s: float
) -> dict[str, Any]:
    done = [report for _, report in reports]
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": options.commit,
        "machine": f"{os.cpu_count()} cores, {_memory_gib()} GiB",
        "seeds": sorted({seed for seed, _ in reports}),
        "minutes": round((time.monotonic() - started_s) / 60, 1),
        "jobs": len(done),
        "faults": sum(len(report.came) for report in done),
        "commands": sum(report.commands for report in done),
        "skipped": sorted(set(KINDS) - set(kinds_here())),
        "kinds": _by_kind(done),
        "wrong": [(seed, report._asdict()) for seed, report in reports if not report.is_good],
    }


def _by_kind(reports: Sequence[Report]) -> dict[str, dict[str, Any]]:
    """Counts of every kind; a leak is counted with all kinds of its job."""
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    for report in reports:
        for fault, outcome in report.came:
            wanted = KINDS[fault.kind].outcome
            row = rows[fault.kind]
            row["injected"] += 1
            row["as wanted" if outcome == wanted else "unexpected"] += 1
            row["leaks"] += bool(report.leaks)
            row["lost checkpoints"] += bool(report.lost)
            row["not bit-equal"] += not report.is_equal
    return {
        kind: {"outcome": KINDS[kind].outcome} | {name: rows[kind][name] for name in COLUMNS}
        for kind in KINDS
        if kind in rows
    }


def _table(kinds: dict[str, dict[str, Any]]) -> str:
    line: Callable[..., str] = "{:24} {:>17} {:>9} {:>10} {:>11} {:>6} {:>17} {:>14}".format
    rows = [line(kind, *row.values()) for kind, row in kinds.items()]
    sums = [sum(row[name] for row in kinds.values()) for name in COLUMNS]
    return "\n".join((line("kind", "outcome", *COLUMNS), *rows, line("all", "", *sums)))


def _memory_gib() -> int:
    return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30)


def _said(*command: str) -> str:
    return subprocess.run(
        command, cwd=_TESTS, capture_output=True, text=True, check=False
    ).stdout.strip()


def _print(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
