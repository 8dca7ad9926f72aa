"""Runs suites of training commands and keeps what they measured.

`python -m benchmarks.run scaling --repeats 3` runs the cases in turn (A B C A B C ...), prints
the medians, and adds a call with every run in it to `benchmarks/results/<suite>.json`. With
`--gpus 4` as many runs go on at a time as there are GPUs for, each alone on its own. With
`--deadline-s` runs that would not end in time are not started. `--resume` goes on with the last
call, if code and machine are still the same. With `--gpus` NVML says which part of their SMs was
busy (Hopper and newer).
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.busy_sms import BusySms
from benchmarks.cases import SUITES, Case
from benchmarks.evaluation.figures import RATES, Figure, figure, over, shown
from benchmarks.evaluation.writer import markdown
from benchmarks.free_gpus import on_free_gpus
from benchmarks.outcomes import return_curve
from benchmarks.records import ResultsFile
from benchmarks.runner import (
    STOP_S,
    as_word,
    deadline,
    exit_code,
    failure_of,
    in_turn,
    options,
)
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.history import read_metrics


def main() -> int:
    """Runs what the command line asks for; returns 1 if a run failed or had no time, else 0."""
    given = _options()
    files = [
        (cases, _file(suite, cases, given))
        for suite in given.suites
        if (cases := [case for case in SUITES[suite] if given.only in case.name])
    ]
    if not files:
        raise ConfigError(f"--only {given.only!r}: no case of these suites has that in its name")
    large = [one for cases, _ in files for one in cases if one.gpus > (given.gpus or one.gpus)]
    if len(large) == sum(len(cases) for cases, _ in files):
        raise ConfigError(f"--gpus {given.gpus}: every case of these suites needs more")
    for case in large:
        sys.stderr.write(f"{case.name}: left out, it needs {case.gpus} GPUs\n")
    deadline_s = deadline(given.deadline_s)
    with tempfile.TemporaryDirectory() as scratch:
        turns = [
            _Turn(file, case, repeat, given.runs or Path(scratch), deadline_s)
            for cases, file in files
            for repeat, case in in_turn(cases, given.repeats)
            if case not in large and not is_done(file.results, case, repeat)
        ]
        on_free_gpus(given.gpus or None, turns, lambda turn: turn.case.gpus, _Turn.run)
    for _, file in files:
        print(*table(file.results), f"written: {file.path}", sep="\n")
    left = sum(not is_done(turn.file.results, turn.case, turn.repeat) for turn in turns)
    if left:
        sys.stderr.write(f"{left} of {len(turns)} runs failed or had no time: see --resume\n")
    return int(bool(left))


def _file(suite: str, cases: Sequence[Case], given: argparse.Namespace) -> ResultsFile:
    """The file of a suite, with a call that has these cases."""
    path = given.out / f"{suite}.json"
    file = ResultsFile(path, suite, vars(given), resume=given.resume)
    known = file.results.setdefault("cases", {})
    for case in cases:
        command = " ".join(("python -m gmijax.train", *case.overrides))
        known.setdefault(case.name, {"command": command, "runs": []})
    return file


def is_done(results: Mapping[str, Any], case: Case, repeat: int) -> bool:
    """Whether a run has succeeded."""
    runs = results["cases"][case.name]["runs"]
    return any(run["repeat"] == repeat and "summary" in run for run in runs)


class _Turn(NamedTuple):
    """One run that is to be made, in a new folder below `runs`."""

    file: ResultsFile
    case: Case
    repeat: int
    runs: Path
    deadline_s: float

    def run(self, gpus: Sequence[int]) -> None:
        """Runs it, and writes: an interruption loses the running ones only."""
        if time.monotonic() + self._longest_s() >= self.deadline_s - STOP_S:
            return
        started_s = time.monotonic()
        name = f"{self.file.suite}-{as_word(self.case.name)}-{self.repeat}"
        folder = unused(self.runs / name)
        own = (f"plan.gpus=[{','.join(map(str, gpus))}]",) if gpus else ()
        with BusySms(gpus) as busy:
            done = run_case(self.case, self.repeat, (*own, f"run.dir={folder}"), folder)
        if "summary" in done:
            done["busy_sms"] = busy.between(*training_of(folder))
        with self.file.changing() as results:
            kept = results["cases"][self.case.name]
            kept["config"] = done.pop("config", kept.get("config"))
            # Runs that go on at the same time are noted as they end: each has its number.
            command_s = round(time.monotonic() - started_s, 2)
            kept["runs"].append({**done, "repeat": self.repeat, "command_s": command_s})

    def _longest_s(self) -> float:
        """That a run of this case took in this call, before the first that one of any case did."""
        cases = self.file.results["cases"]
        mine = cases[self.case.name]["runs"]
        runs = mine or [run for case in cases.values() for run in case["runs"]]
        return max((run["command_s"] for run in runs), default=0.0)


def unused(folder: Path) -> Path:
    """`folder`, or with a number more where an interrupted run has left it."""
    more = (Path(f"{folder}-{number}") for number in itertools.count(2))
    return next(path for path in itertools.chain((folder,), more) if not path.exists())


def run_case(case: Case, repeat: int, overrides: Sequence[str], folder: Path) -> dict[str, Any]:
    """One run: its `outcome`, or what its command wrote when it failed."""
    own = (text.format(run=repeat) for text in case.overrides)
    failure = failure_of([sys.executable, "-m", "gmijax.train", *own, *overrides])
    if failure is None:
        return outcome(folder)
    sys.stderr.write(f"{case.name}: {failure}\n")
    return {"failed": failure}


def outcome(folder: Path) -> dict[str, Any]:
    """Configuration, summary and thinned curve of a run, and medians of what it logged."""
    lines = read_metrics(RunPaths(folder).metrics)
    names = [key for key in lines[-1] if key.startswith(("time/", "loss/", "async/"))]
    return {
        "config": read_json(RunPaths(folder).config),
        "summary": read_json(RunPaths(folder).summary),
        "curve": return_curve(lines),
        "evaluations": [
            [line["env_steps"], line["eval/return"]]
            for line in lines
            if line.get("eval/return") is not None
        ],
        "metrics": {
            k: v for k, v in lines[-1].items() if k.startswith("metric/") and v is not None
        },
        "diverged_steps": sum(line["diverged_steps"] for line in lines),
        "medians": {name: median(lines, name) for name in names},
    }


def training_of(folder: Path) -> tuple[float, float]:
    """When a run had made its first iteration, and its last: seconds of `time.time`."""
    path = RunPaths(folder).metrics
    lines, end_s = read_metrics(path), path.stat().st_mtime
    return end_s - (lines[-1]["wall_s"] - lines[0]["wall_s"]), end_s


def median(lines: Sequence[Mapping[str, Any]], key: str) -> float | None:
    """Over the lines that have a value; None of nothing."""
    found = [line[key] for line in lines if line.get(key) is not None]
    return statistics.median(found) if found else None


def table(results: Mapping[str, Any]) -> list[str]:
    """Medians over the runs of a call, one row per case, with the ratio to the first case.

    The spread is that of the rate of training, of the fastest run less the slowest.
    """
    rows: list[list[str]] = []
    first: Figure | None = None
    for name, case in results["cases"].items():
        summaries = [run["summary"] for run in case["runs"] if "summary" in run]
        if not summaries:
            failure = case["runs"][-1]["failed"] if case["runs"] else "not run"
            rows.append([name, failure, *[""] * 6])
            continue
        simulated, inferred, trained, final = (
            figure([one[key] for one in summaries if one.get(key) is not None])
            for key in (*RATES, "final_return")
        )
        first = first or trained
        memory = figure([one["device"]["peak_memory_mib"] for one in summaries])
        spread = (trained.high - trained.low) / trained.median if trained else None
        rates = (found and found.median for found in (simulated, inferred, trained))
        rows.append(
            [
                name,
                *(shown(found, ",.0f") for found in rates),
                *(shown(spread, ".1%"), shown(over(trained, first))),
                *(shown(found and found.median, ",.0f") for found in (final, memory)),
            ]
        )
    head = "case | sim: | inference: | train: | spread: | ratio: | return: | MiB:"
    return markdown(head, rows)


def _options() -> argparse.Namespace:
    parser = options("run", __doc__)
    parser.epilog = f"suites: {', '.join(sorted(SUITES))}"
    parser.add_argument("suites", nargs="+", choices=sorted(SUITES), metavar="SUITE")
    parser.add_argument("--only", default="", metavar="TEXT", help="cases with TEXT in the name")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--gpus", type=int, help="run cases at the same time on so many GPUs")
    parser.add_argument("--deadline-s", type=float, help="seconds for all of it")
    parser.add_argument("--runs", type=Path, help="keep the run folders here")
    parser.add_argument("--resume", action="store_true", help="add to the runs in the JSON file")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(exit_code(main))
