"""Runs a suite of training commands and keeps what they measured.

`python -m benchmarks.run ant-1gpu --repeats 3` runs the cases in turn (A B C A B C ...), prints
the medians, and writes `benchmarks/results/<suite>.json` with every run in it.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.cases import SUITES, Case
from gmijax.results import read_metrics

RESULTS = Path(__file__).parent / "results"
RATES = ("step_per_s_sim", "step_per_s_inference", "step_per_s_train")
CURVE_POINTS = 60


def main() -> int:
    """Runs what the command line asks for; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", choices=sorted(SUITES))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    parser.add_argument("--runs", type=Path, help="keep the run folders here")
    parser.add_argument("--resume", action="store_true", help="add to the runs in the JSON file")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{arguments.suite}.json"
    kept = json.loads(path.read_text())["cases"] if arguments.resume and path.exists() else {}
    with tempfile.TemporaryDirectory() as scratch:
        results = run_suite(
            arguments.suite, arguments.repeats, arguments.runs or Path(scratch), path, kept
        )
    sys.stdout.write(f"{table(results)}\nwritten: {path}\n")
    return 0


def run_suite(
    suite: str, repeats: int, runs: Path, path: Path, kept: dict[str, Any]
) -> dict[str, Any]:
    """Runs the cases of a suite in turn until each has `repeats` runs; all must succeed.

    The JSON file at `path` is written after every run: an interruption loses one run at most.
    """
    cases = {
        case.name: kept.get(case.name, {"command": command(case), "runs": []})
        for case in SUITES[suite]
    }
    results = {"suite": suite, "cases": cases}
    for repeat in range(repeats):
        for number, case in enumerate(SUITES[suite]):
            if len(cases[case.name]["runs"]) > repeat:
                continue
            folder = runs / f"{suite}-{number}-{repeat}"
            subprocess.run(
                [sys.executable, "-m", "gmijax.train", *case.overrides, f"run.dir={folder}"],
                check=True,
                stdout=subprocess.DEVNULL,
            )
            cases[case.name]["runs"].append(outcome(folder))
            path.write_text(json.dumps(results, indent=1) + "\n")
    return results


def command(case: Case) -> str:
    """The command line of a case."""
    return " ".join(("python -m gmijax.train", *case.overrides))


def outcome(folder: Path) -> dict[str, Any]:
    """The summary of a run, its curve thinned out, and the median times of its parts."""
    lines = read_metrics(folder / "metrics.jsonl")
    kept = lines[:: max(1, len(lines) // CURVE_POINTS)]
    times = [key for key in lines[-1] if key.startswith("time/")]
    return {
        "summary": json.loads((folder / "summary.json").read_text()),
        "curve": [[line["env_steps"], line["wall_s"], line["return"]] for line in kept],
        "diverged_steps": sum(line["diverged_steps"] for line in lines),
        "times": {key: statistics.median(line[key] for line in lines) for key in times},
    }


def table(results: dict[str, Any]) -> str:
    """Medians over the runs, one row per case, with the ratio to the first case."""
    rows = [f"{'case':32} {'sim':>10} {'inference':>10} {'train':>10} {'ratio':>6} {'return':>8}"]
    first: float | None = None
    for name, case in results["cases"].items():
        summaries = [run["summary"] for run in case["runs"]]
        rates = [median(summaries, rate) for rate in RATES]
        first = first or rates[-1]
        shown = " ".join(f"{rate:10,.0f}" for rate in rates)
        final = median(summaries, "final_return")
        rows.append(f"{name:32} {shown} {rates[-1] / first:6.2f} {final:8,.0f}")
    return "\n".join(rows)


def median(summaries: list[dict[str, Any]], key: str) -> float:
    """Median of a figure over runs, NaN where it was not measured."""
    values = [summary[key] for summary in summaries]
    return math.nan if None in values else statistics.median(values)


if __name__ == "__main__":
    sys.exit(main())
