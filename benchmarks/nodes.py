"""Two nodes of one GPU each against one node with both: `python -m benchmarks.nodes`.

On a host with two GPUs it starts two nodes of Ray with one GPU each, and trains in turn on one
node with both GPUs and on the two nodes, which exchange by NCCL directly (NVLink or PCIe), by NCCL
over sockets, as machines do, and by TCP (`reduce.strategy=mpr`). `--gmis 1 2` does all of it with
one GMI on each GPU, then with two. `--sweep 2` and `--pack 1` run as many jobs at once on each GPU
as a sweep, and as a pack of the training's command, on one node and on two.
Writes `benchmarks/results/nodes-<device>.json` after every run. Without GPUs the nodes have the
CPUs, and exchange by TCP.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gmijax
from benchmarks.evaluation.node_tables import HEAD, rows_of
from benchmarks.evaluation.writer import markdown
from benchmarks.node_cases import WAYS, Case, cases_of, words_of
from benchmarks.records import results_file
from benchmarks.run import outcome, unused
from benchmarks.runner import Command, as_word, deadline, exit_code, failures_of, in_turn, options
from benchmarks.two_ray_nodes import two_nodes
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.partition.reduction import why_no_bindings, why_no_nccl
from gmijax.runs.folder import RunPaths, read_json

JOB = ("env=ant", "num_envs=8192", "num_timesteps=60e6", "run.max_restarts=0")
LONGEST_S = 180.0
"""Of a run: nodes that cannot reach each other by NCCL wait for much longer."""


def measured_in(case: Case, folder: Path) -> dict[str, Any]:
    """What a run that succeeded has left: of several jobs, steps/s are the sum over them."""
    if case.verb == "train":
        found = outcome(folder)
        log = RunPaths(folder).gmi(0).stdout.read_text()
        via = sorted(set(re.findall(r"via (\w+)/", log)))  # What NCCL says that it takes.
        return {key: found[key] for key in ("config", "summary", "medians")} | {"via": via}
    report = read_json(folder / f"{case.verb}.json")
    below = "train" if case.verb == "pack" else ""
    runs = [RunPaths(Path(job["run_dir"]) / below) for job in report["jobs"]]
    rates = [read_json(run.summary)["step_per_s_train"] for run in runs]
    per_hour = report["trainings_per_hour"]
    return {"summary": {"step_per_s_train": sum(rates), "trainings_per_hour": per_hour}}


def main() -> int:
    """Runs what the command line asks for; returns 1 if a run failed or had no time, else 0."""
    given, machine = _options(), detect_machine()
    if len(machine.gpus) == 1:
        raise ConfigError("benchmarks.nodes: needs two GPUs, or none; this machine has one")
    why_not = (why_no_nccl() or why_no_bindings()) if machine.gpus else "NCCL needs GPUs"
    cases = cases_of(given.gmis, given.sweep, given.pack, why_not)
    benchmark = Benchmark(given, machine)
    with tempfile.TemporaryDirectory() as scratch:
        num_done = benchmark.run(cases, (given.runs or Path(scratch)).resolve())
    file = benchmark.file
    print(*markdown(HEAD, [*rows_of(file.results)]), f"written: {file.path}", sep="\n")
    if left := (wanted := len(cases) * given.repeats) - num_done:
        sys.stderr.write(f"{left} of {wanted} runs failed or had no time\n")
    return int(left > 0)


class Benchmark:
    """The runs of one call.

    Attributes:
      file: has each of them after its end.
    """

    def __init__(self, given: argparse.Namespace, machine: Machine) -> None:
        self._given = given
        self._gpus = [gpu.index for gpu in machine.gpus[:2]]
        self._num_cpus = max(2, len(machine.cpu_cores) // 2)
        self._overrides = [
            *{one.partition("=")[0]: one for one in (*JOB, *given.overrides)}.values()
        ]
        config = gmijax.compose(*self._overrides)
        self._task = f"`{config.env.slug}`, {config.num_envs:,} environments in a GMI"
        self._deadline_s = deadline(given.deadline_s)
        self.file = results_file(given, "nodes", gpus=2)

    def run(self, cases: Sequence[Case], root: Path) -> int:
        """Runs them in turn, in folders below `root`; how many runs succeeded."""
        root.mkdir(parents=True, exist_ok=True)
        turns = in_turn(cases, self._given.repeats, self._deadline_s, like=lambda case: case.job)
        num_done = 0
        with two_nodes(root / "ray.txt", self._gpus, self._num_cpus) as cluster:
            for repeat, case in turns:
                folder = unused(root / f"{as_word(f'{case.job} {case.way}')}-{repeat}")
                folder.mkdir()
                words = words_of(
                    case, self._overrides, self._gpus, cluster.address, folder / "run"
                )
                run = {"repeat": repeat, **self._measure(case, words, folder)}
                num_done += "summary" in run
                self._add(case, run)
        return num_done

    def _measure(self, case: Case, words: Sequence[str], folder: Path) -> dict[str, Any]:
        started_s = time.monotonic()
        command = Command([sys.executable, *words], folder, WAYS[case.way].variables)
        [failure] = failures_of([command], min(self._deadline_s, started_s + LONGEST_S))
        found: dict[str, Any] = (
            {"failed": failure} if failure else measured_in(case, folder / "run")
        )
        command_s = round(time.monotonic() - started_s, 2)
        rate = failure or f"{found['summary']['step_per_s_train']:,.0f} steps/s"
        print(f"{case.job}: {case.way}: {rate}, {command_s} s", flush=True)
        return {**found, "command_s": command_s}

    def _add(self, case: Case, run: dict[str, Any]) -> None:
        about = {"job": f"{self._task}, {case.job}", "way": case.way, "runs": []}
        with self.file.changing() as results:
            kept = results.setdefault("cases", {}).setdefault(f"{case.job}: {case.way}", about)
            kept["config"] = run.pop("config", kept.get("config"))
            kept["runs"].append(run)


def _options() -> argparse.Namespace:
    parser = options("nodes", __doc__)
    parser.add_argument("overrides", nargs="*", help=f"of the training, beside {' '.join(JOB)}")
    parser.add_argument("--gmis", type=int, nargs="*", default=[1, 2], help="on each GPU")
    parser.add_argument("--sweep", type=int, nargs="*", default=[], help="jobs on each GPU")
    parser.add_argument("--pack", type=int, nargs="*", default=[], help="jobs on each GPU")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--deadline-s", type=float, help="seconds for all of it")
    parser.add_argument("--runs", type=Path, help="keep the run folders here")
    return parser.parse_intermixed_args()


if __name__ == "__main__":
    sys.exit(exit_code(main))
