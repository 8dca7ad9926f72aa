"""Compares the paper's resource model with measured ratios of co-located to dedicated GMIs.

`python -m benchmarks.resource_model MEASURED.json ...` prints a Markdown table. Each file is
`{"cases": [...]}`; a case has

- `name`;
- `simulator_s`, `agent_s` and, for training, `trainer_s`: T_s, T_a, T_t in one iteration, seconds;
- `com_s`: what an iteration spends on moving data between GMIs where tasks have GMIs of their
  own; for training `reduce_s` too, what it spends on gradients where they have not;
- `colocated`, `dedicated`: env steps/s measured with TCG and TDG, or TCG_EX and TDG_EX, on as
  many GPUs; without them only the prediction is printed;
- optionally `simulator_r`, `agent_r`, `trainer_r`, `alpha`, `beta`: R_s, R_a, R_t in any unit, and
  the sharing factors; the paper's ratios (10 : 1 : 2, 0.2, 0.3) where they were not measured.

A file of `python -m benchmarks.run templates-<task>` is one case, see `training_case`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.paper_model import Task, serving_gain, training_gain

_TRAINING = ("tcg_ex", "tdg_ex")
PAPER = {"simulator_r": 10.0, "agent_r": 1.0, "trainer_r": 2.0, "alpha": 0.2, "beta": 0.3}


def main() -> int:
    """Prints the table of all cases of all files; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path, metavar="MEASURED.json")
    parser.add_argument(
        "--resources", type=Path, help="R_s, R_a and R_t, from python -m benchmarks.resource_use"
    )
    arguments = parser.parse_args()
    cases = [case for file in arguments.files for case in cases_of(file)]
    if arguments.resources is not None:
        uses = json.loads(arguments.resources.read_text())["tasks"]
        cases = [{**resources_of(case["name"], uses), **case} for case in cases]
    sys.stdout.write("\n".join(table(cases)) + "\n")
    return 0


def cases_of(file: Path) -> list[dict[str, Any]]:
    """The cases in a file of either kind."""
    results = json.loads(file.read_text())
    cases = results["cases"]
    if not isinstance(cases, list):
        return [training_case(results["suite"], cases)]
    if missing := [case["name"] for case in cases if "simulator_s" not in case]:
        sys.stderr.write(f"{file}: left out, no times of its stages: {'; '.join(missing)}\n")
    return [case for case in cases if "simulator_s" in case]


def resources_of(name: str, uses: Mapping[str, Any]) -> dict[str, float]:
    """R of the tasks of a case, by the environment that its name has; none if there is no such.

    Parts of a GPU: of SMs, or of memory where that is more (equation 1).
    """
    parts = next((use for env, use in uses.items() if env in name), {})
    return {f"{task}_r": max(part["sm"], part["memory"]) for task, part in parts.items()}


def training_case(name: str, cases: Mapping[str, Any]) -> dict[str, Any]:
    """A case from the medians of a `templates-<task>` suite.

    A rollout is one program, so T_s has T_a in it. What a dedicated trainer waits longer for its
    rollouts than a co-located one takes to make them is what moving them costs.
    """
    tcg, tdg = (next(c["runs"][0] for n, c in cases.items() if n.endswith(t)) for t in _TRAINING)
    rollout_s, reduce_s = (tcg["medians"][f"time/{part}_s"] for part in ("rollout", "reduce"))
    longer_s = max(0.0, tdg["medians"]["time/rollout_s"] - rollout_s)
    return {
        "name": name,
        "simulator_s": rollout_s,
        "agent_s": 0.0,
        "trainer_s": tcg["medians"]["time/update_s"] - reduce_s,
        "reduce_s": reduce_s,
        "com_s": longer_s + (tdg["medians"].get("time/reduce_s") or 0.0),
        "colocated": tcg["summary"]["step_per_s_train"],
        "dedicated": tdg["summary"]["step_per_s_train"],
    }


def table(cases: list[dict[str, Any]]) -> Iterator[str]:
    """Predicted and measured gain of co-location, a row per case."""
    yield "| case | T_s ms | T_a ms | T_t ms | COM/BW ms | COM/BW over work | model | measured |"
    yield "|---|---|---|---|---|---|---|---|"
    for case in cases:
        times = [case[f"{task}_s"] for task in ("simulator", "agent")]
        times.append(case.get("trainer_s") or 0.0)
        columns = [case["name"], *(f"{1e3 * seconds:.2f}" for seconds in (*times, case["com_s"]))]
        columns.append(f"{case['com_s'] / sum(times):.2f}")
        columns.append(f"{predicted_gain(case):.2f}")
        columns.append(f"{measured:.2f}" if (measured := measured_gain(case)) else "-")
        yield f"| {' | '.join(columns)} |"


def predicted_gain(case: Mapping[str, Any]) -> float:
    """Throughput of co-located over dedicated GMIs, by equation 2 or, with a trainer, 3."""
    given = {**PAPER, **{key: value for key, value in case.items() if value is not None}}
    simulator = Task(given["simulator_s"], given["simulator_r"])
    agent = Task(given["agent_s"], given["agent_r"])
    if "trainer_s" not in given:
        return serving_gain(simulator, agent, given["alpha"], given["com_s"])
    return training_gain(
        simulator,
        agent,
        Task(given["trainer_s"], given["trainer_r"]),
        (given["alpha"], given["beta"]),
        (given.get("reduce_s", 0.0), given["com_s"]),
    )


def measured_gain(case: Mapping[str, Any]) -> float | None:
    """The same as measured, None if it was not."""
    together, apart = case.get("colocated"), case.get("dedicated")
    return together / apart if together and apart else None


if __name__ == "__main__":
    sys.exit(main())
