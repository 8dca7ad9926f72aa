"""Measures serving: `python -m benchmarks.serving`, simulator and agent together and apart.

The same environments act with random actions in m GMIs (template `tcg`), and in m GMIs that
simulate plus one that infers (`tdg`). With `--backends mps share` both run under both. With
several `--envs` every number of GMIs runs with each. With `--gpus` cases run at the same time,
each on a GPU of its own with its part of the cores. A case that would not end in time, as long as
the longest one before, is not started. Adds a call to
`benchmarks/results/serving-<device>.json`; `simulator_s`, `agent_s` and `com_s` in it are medians
of the stages of one dedicated step of all environments of a GMI.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.evaluation.serving_tables import SERVING_HEAD, serving_row
from benchmarks.evaluation.writer import markdown
from benchmarks.free_gpus import Part, on_parts
from benchmarks.records import results_file
from benchmarks.runner import as_word, deadline, exit_code, failure_of, in_turn, options
from gmijax.machine.snapshot import detect_machine
from gmijax.runs.folder import RunPaths, read_json

Summary = Mapping[str, Any]


class Setting(NamedTuple):
    """What is compared.

    Attributes:
      task: its name.
      backend: how GMIs share the GPU.
      simulators: m, GMIs that simulate.
      num_envs: environments of each.
    """

    task: str
    backend: str
    simulators: int
    num_envs: int

    @property
    def name(self) -> str:
        """What tables call it."""
        return f"{self.task} {self.simulators} x {self.num_envs}, {self.backend}"

    def command(self, given: argparse.Namespace, template: str, name: str) -> list[str]:
        """One job, whose run has this name."""
        gmis = self.simulators + (template == "tdg")
        steps = self.simulators * self.num_envs * given.unroll_length * given.unrolls
        return [
            *(sys.executable, "-m", "gmijax.serve", f"env={self.task}", "policy=random"),
            *(f"num_envs={self.num_envs}", f"num_timesteps={steps}"),
            *(f"unroll_length={given.unroll_length}", f"plan.gmis_per_gpu={gmis}"),
            *(f"plan.template={template}", f"plan.backend={self.backend}"),
            *(f"physics.impl={given.impl}", f"run.name={name}"),
        ]


def main() -> int:
    """Measures what the command line asks for; returns 1 if a job failed, else 0."""
    given, machine = _options(), detect_machine()
    file, deadline_s = results_file(given, "serving", gpus=1), deadline(given.deadline_s)
    took_s = [0.0]

    def run(setting: Setting, part: Part) -> None:
        started_s = time.monotonic()
        if started_s + max(took_s) >= deadline_s:
            return
        case = measure(setting, given, part)
        took_s.append(time.monotonic() - started_s)
        file.add("cases", case)
        print(*markdown(SERVING_HEAD, [serving_row(case)]), sep="\n", flush=True)

    on_parts(machine, given.gpus, settings_of(given), run)
    return int(any("failed" in case for case in file.results.get("cases", ())))


def settings_of(given: argparse.Namespace) -> list[Setting]:
    """The environments of a task are split over its simulators; one alone shares with nobody."""
    first, *_ = given.backends
    return [
        Setting(task, backend, m, envs // m)
        for task, envs, backend, m in itertools.product(
            given.tasks, given.envs, given.backends, given.simulators
        )
        if m > 1 or backend == first or "tdg" in given.templates
    ]


def measure(setting: Setting, given: argparse.Namespace, part: Part) -> dict[str, Any]:
    """Both templates in turn, as often as wanted; a case of the file.

    Throughputs and times are medians over the repeats; every repeat's summary is kept.
    """
    runs: dict[str, list[Summary]] = {"tcg": [], "tdg": []}
    with tempfile.TemporaryDirectory() as scratch:
        for repeat, template in in_turn(given.templates, given.repeats):
            name = f"{as_word(setting.name)}-{template}-{repeat}"
            command = [*part.prefix, *setting.command(given, template, name)]
            if failure := failure_of(command, Path(scratch), part.variables):
                sys.stderr.write(f"{setting.name}, {template}: {failure}\n")
                return {"name": setting.name, "failed": failure}
            runs[template].append(read_json(RunPaths(Path(scratch) / "runs" / name).summary))
    first = next(found[0] for found in runs.values() if found)
    case: dict[str, Any] = {"name": setting.name, **setting._asdict(), "impl": first.get("impl")}
    case["runs"] = runs
    for template, name in (("tcg", "colocated"), ("tdg", "dedicated")):
        if runs[template]:
            case[name] = statistics.median(run["step_per_s_inference"] for run in runs[template])
    if runs["tdg"]:
        simulate, infer, exchange = (
            statistics.median(run["stages_ms"][name]["p50"] / 1e3 for run in runs["tdg"])
            for name in ("simulate", "infer", "exchange")
        )
        # COM: pipes, copies between host and device, and waiting for the agent's turn.
        case |= {"simulator_s": simulate, "agent_s": infer, "com_s": exchange - infer}
    return case


def _options() -> argparse.Namespace:
    parser = options("serving", __doc__)
    parser.add_argument("--tasks", nargs="+", default=["ant", "humanoid"], metavar="TASK")
    parser.add_argument("--backends", nargs="+", default=["auto"], metavar="BACKEND")
    parser.add_argument("--templates", nargs="+", default=["tcg", "tdg"], choices=["tcg", "tdg"])
    parser.add_argument("--simulators", nargs="+", type=int, default=[1, 2, 4], metavar="M")
    parser.add_argument(
        "--envs", nargs="+", type=int, default=[8192], help="environments of all GMIs together"
    )
    parser.add_argument("--impl", default="auto", choices=["auto", "jax", "warp"])
    parser.add_argument("--unroll-length", type=int, default=32)
    parser.add_argument("--unrolls", type=int, default=20, help="unrolls of every GMI")
    parser.add_argument("--gpus", type=int, default=1, help="for cases at the same time")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--deadline-s", type=float, help="seconds for all of it")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(exit_code(main))
