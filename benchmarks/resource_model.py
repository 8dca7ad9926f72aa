"""Compares the paper's resource model with measured ratios of co-located to dedicated GMIs.

`python -m benchmarks.resource_model benchmarks/results/serving-nvidia-h200.json` prints a Markdown
table of the cases in files of `python -m benchmarks.serving` whose stages were timed. The paper's
ratios of R and its alpha stand in for what was not measured; `--resources` reads R from a file of
`python -m benchmarks.resource_use`.

Training has no such table: its iteration is one program, whose stages are not timed apart.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.paper_model import Task, serving_gain
from benchmarks.records import read_calls
from gmijax.errors import ConfigError

PAPER = {"simulator_r": 10.0, "agent_r": 1.0, "alpha": 0.2}


def main() -> int:
    """Prints the table of all cases of all files; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path, metavar="SERVING.json")
    parser.add_argument(
        "--resources", type=Path, help="R_s and R_a, from python -m benchmarks.resource_use"
    )
    arguments = parser.parse_args()
    try:
        cases = [case for file in arguments.files for case in cases_of(file)]
        if arguments.resources is not None:
            uses = read_calls(arguments.resources)[-1].results["tasks"]
            cases = [{**resources_of(case["name"], uses), **case} for case in cases]
    except ConfigError as error:
        parser.error(str(error))
    sys.stdout.write("\n".join(table(cases)) + "\n")
    return 0


def cases_of(file: Path) -> list[dict[str, Any]]:
    """The cases whose stages were timed, of the file's last call that has any.

    Raises:
      ConfigError: there are none.
    """
    for call in reversed(read_calls(file)):
        cases = call.results.get("cases")
        if isinstance(cases, list) and (timed := [c for c in cases if "simulator_s" in c]):
            return timed
    raise ConfigError(f"{file}: no case with times of its stages")


def resources_of(name: str, uses: Mapping[str, Any]) -> dict[str, float]:
    """R of the tasks of a case, by the environment that its name has; none if there is no such.

    Parts of a GPU: of SMs, or of memory where that is more (equation 1).
    """
    parts = next((use for env, use in uses.items() if env in name), {})
    return {f"{task}_r": max(part["sm"], part["memory"]) for task, part in parts.items()}


def table(cases: list[dict[str, Any]]) -> Iterator[str]:
    """Predicted and measured gain of co-location, a row per case."""
    yield "| case | T_s ms | T_a ms | COM/BW ms | COM/BW over work | model | measured |"
    yield "|---|---|---|---|---|---|---|"
    for case in cases:
        times = [case["simulator_s"], case["agent_s"]]
        columns = [case["name"], *(f"{1e3 * seconds:.2f}" for seconds in (*times, case["com_s"]))]
        columns.append(f"{case['com_s'] / sum(times):.2f}")
        columns.append(f"{predicted_gain(case):.2f}")
        columns.append(f"{measured:.2f}" if (measured := measured_gain(case)) else "-")
        yield f"| {' | '.join(columns)} |"


def predicted_gain(case: Mapping[str, Any]) -> float:
    """Throughput of co-located over dedicated GMIs, by equation 2."""
    given = {**PAPER, **case}
    simulator = Task(given["simulator_s"], given["simulator_r"])
    agent = Task(given["agent_s"], given["agent_r"])
    return serving_gain(simulator, agent, given["alpha"], given["com_s"])


def measured_gain(case: Mapping[str, Any]) -> float | None:
    """The same as measured, None if it was not."""
    together, apart = case.get("colocated"), case.get("dedicated")
    return together / apart if together and apart else None


if __name__ == "__main__":
    sys.exit(main())
