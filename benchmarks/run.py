"""Runs suites of training commands and keeps what they measured.

`python -m benchmarks.run ant-1gpu --repeats 3` runs the cases in turn (A B C A B C ...), prints
the medians, and adds a call with every run in it to `benchmarks/results/<suite>.json`. With
`--gpus 4` as many runs go on at a time as there are GPUs for, each alone on its own. `--resume`
goes on with the last call, if code and machine are still the same.
"""

from __future__ import annotations

import argparse
import itertools
import math
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from benchmarks.cases import SUITES, Case
from benchmarks.free_gpus import FreeGpus
from benchmarks.records import RESULTS, ResultsFile
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.history import read_metrics

RATES = ("step_per_s_sim", "step_per_s_inference", "step_per_s_train")
CURVE_POINTS = 60


def main() -> int:
    """Runs what the command line asks for; returns 1 if a run failed, else 0."""
    suites = f"suites: {', '.join(sorted(SUITES))}"
    parser = argparse.ArgumentParser(description=__doc__, epilog=suites)
    parser.add_argument("suites", nargs="+", choices=sorted(SUITES), metavar="SUITE")
    parser.add_argument(
        "--only", default="", metavar="TEXT", help="cases with TEXT in their names"
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--gpus", type=int, help="run cases at the same time on so many GPUs")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON files")
    parser.add_argument("--runs", type=Path, help="keep the run folders here")
    parser.add_argument("--resume", action="store_true", help="add to the runs in the JSON file")
    arguments = parser.parse_args()
    cases = [c for suite in arguments.suites for c in SUITES[suite] if arguments.only in c.name]
    if not cases:
        parser.error(f"--only {arguments.only!r}: no case of these suites has that in its name")
    if arguments.gpus is not None:
        large = [case for case in cases if case.gpus > arguments.gpus]
        if len(large) == len(cases):
            parser.error(f"--gpus {arguments.gpus}: every case of these suites needs more")
        for case in large:
            sys.stderr.write(f"{case.name}: left out, it needs {case.gpus} GPUs\n")
    wanted = {case.name for case in cases}
    suites = [s for s in arguments.suites if any(case.name in wanted for case in SUITES[s])]
    try:
        books = {suite: _book(suite, wanted, arguments) for suite in suites}
    except ConfigError as error:
        parser.error(str(error))
    with tempfile.TemporaryDirectory() as scratch:
        free = FreeGpus(arguments.gpus) if arguments.gpus else None
        run_all(books, wanted, arguments.repeats, arguments.runs or Path(scratch), free)
    for book in books.values():
        sys.stdout.write(f"{table(book.results)}\nwritten: {book.path}\n")
    return int(any(failures(book.results) for book in books.values()))


def _book(suite: str, wanted: Collection[str], arguments: argparse.Namespace) -> ResultsFile:
    """The file of a suite, with a call that has the suite's wanted cases."""
    path = arguments.out / f"{suite}.json"
    book = ResultsFile(path, suite, vars(arguments), resume=arguments.resume)
    known = book.results.setdefault("cases", {})
    for case in SUITES[suite]:
        if case.name in wanted:
            known.setdefault(case.name, {"command": command(case), "runs": []})
    return book


def missing(
    results: Mapping[str, Any], cases: Collection[Case], repeats: int, gpus: int | None
) -> list[tuple[int, Case]]:
    """Runs to be made of `cases`: those that have not succeeded, none that needs more GPUs.

    Every case once before any case again.
    """
    done = {
        (run["repeat"], name)
        for name, case in results["cases"].items()
        for run in case["runs"]
        if "summary" in run
    }
    return [
        (repeat, case)
        for repeat in range(repeats)
        for case in cases
        if (repeat, case.name) not in done and case.gpus <= (gpus or case.gpus)
    ]


def failures(results: Mapping[str, Any]) -> list[str]:
    """Names of the cases of which a repeat failed, and did not succeed later."""
    return [
        name
        for name, case in results["cases"].items()
        if {run["repeat"] for run in case["runs"]}
        - {run["repeat"] for run in case["runs"] if "summary" in run}
    ]


def run_all(
    books: Mapping[str, ResultsFile],
    wanted: Collection[str],
    repeats: int,
    runs: Path,
    free: FreeGpus | None,
) -> None:
    """Runs the cases `wanted` until each has `repeats` runs; in turn without `free`."""

    def run(suite: str, repeat: int, case: Case) -> None:
        # Letters and digits only: the folder is a value on a command line.
        name = re.sub(r"[^a-zA-Z0-9]+", "-", case.name)
        folder = unused(runs / f"{suite}-{name}-{repeat}")
        with free.taken(case.gpus) if free else nullcontext(()) as overrides:
            done = run_case(case, repeat, (*overrides, f"run.dir={folder}"), folder)
        # Runs that go on at the same time are noted as they end: who is which must be told.
        add(suite, case, {**done, "repeat": repeat})

    def add(suite: str, case: Case, run: dict[str, Any]) -> None:
        """Takes in one run, and writes: an interruption loses the running ones only."""
        with books[suite].changing() as results:
            kept = results["cases"][case.name]
            kept["config"] = run.pop("config", kept.get("config"))
            kept["runs"].append(run)

    with ThreadPoolExecutor(free.count if free else 1) as pool:
        started = [
            pool.submit(run, suite, repeat, case)
            for suite, book in books.items()
            for repeat, case in missing(
                book.results,
                [case for case in SUITES[suite] if case.name in wanted],
                repeats,
                free and free.count,
            )
        ]
        try:
            for one in started:
                one.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def unused(folder: Path) -> Path:
    """`folder`, or with a number more where an interrupted run has left it."""
    more = (Path(f"{folder}-{number}") for number in itertools.count(2))
    return next(path for path in itertools.chain((folder,), more) if not path.exists())


def run_case(case: Case, repeat: int, overrides: tuple[str, ...], folder: Path) -> dict[str, Any]:
    """One run: its `outcome`, or what its command said when it failed."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "gmijax.train"),
            *(text.format(run=repeat) for text in case.overrides),
            *overrides,
        ],
        check=False,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    if done.returncode == 0:
        return outcome(folder)
    said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    sys.stderr.write(f"{case.name}: {said[-1]}\n")
    return {"failed": said[-1]}


def command(case: Case) -> str:
    """The command line of a case."""
    return " ".join(("python -m gmijax.train", *case.overrides))


def outcome(folder: Path) -> dict[str, Any]:
    """Configuration, summary and thinned curve of a run, and medians of what it logged."""
    lines = read_metrics(RunPaths(folder).metrics)
    kept = lines[:: max(1, len(lines) // CURVE_POINTS)]
    kept += [] if kept[-1] is lines[-1] else lines[-1:]
    names = [key for key in lines[-1] if key.startswith(("time/", "loss/", "async/"))]
    return {
        "config": read_json(RunPaths(folder).config),
        "summary": read_json(RunPaths(folder).summary),
        "curve": [[line["env_steps"], line["wall_s"], line["return"]] for line in kept],
        "evaluations": [
            [line["env_steps"], line["eval/return"]]
            for line in lines
            if line.get("eval/return") is not None
        ],
        "metrics": {k: v for k, v in lines[-1].items() if k.startswith("metric/")},
        "diverged_steps": sum(line["diverged_steps"] for line in lines),
        "medians": {name: _median_of(lines, name) for name in names},
    }


def _median_of(lines: list[dict[str, Any]], name: str) -> float | None:
    """Over the lines that have a value."""
    found = [line[name] for line in lines if line.get(name) is not None]
    return statistics.median(found) if found else None


def table(results: dict[str, Any]) -> str:
    """Medians over the runs of a call, one row per case, with the ratio to the first case.

    The spread is that of the rate of training, of the fastest run less the slowest.
    """
    rows = [
        f"{'case':32} {'sim':>10} {'inference':>10} {'train':>10} {'spread':>6} {'ratio':>6} "
        f"{'return':>8} {'MiB':>7}"
    ]
    first: float | None = None
    for name, case in results["cases"].items():
        summaries = [run["summary"] for run in case["runs"] if "summary" in run]
        if not summaries:
            rows.append(f"{name:32} {case['runs'][-1]['failed'] if case['runs'] else 'not run'}")
            continue
        rates = [median(summaries, rate) for rate in RATES]
        first = first or rates[-1]
        shown = " ".join(f"{rate:10,.0f}" for rate in rates)
        final = median(summaries, "final_return")
        memory = median([summary["device"] for summary in summaries], "peak_memory_mib")
        trained = [summary["step_per_s_train"] for summary in summaries]
        spread = (max(trained) - min(trained)) / rates[-1]
        rows.append(
            f"{name:32} {shown} {spread:6.1%} {rates[-1] / first:6.2f} {final:8,.0f} "
            f"{memory:7,.0f}"
        )
    return "\n".join(rows)


def median(summaries: list[dict[str, Any]], key: str) -> float:
    """Median of a figure over runs, NaN where it was not measured."""
    values = [summary[key] for summary in summaries if summary.get(key) is not None]
    return statistics.median(values) if len(values) == len(summaries) else math.nan


if __name__ == "__main__":
    sys.exit(main())
