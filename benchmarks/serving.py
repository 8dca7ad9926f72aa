"""Measures serving: `python -m benchmarks.serving`, simulator and agent together and apart.

The same environments act with random actions in m GMIs (template `tcg`), and in m GMIs that
simulate plus one that infers (`tdg`). With `--backends mps share` both run under both. Adds a call
to `benchmarks/results/serving-<device>.json`; `simulator_s`, `agent_s` and `com_s` in it are
medians of the stages of one dedicated step of all environments of a GMI.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.records import RESULTS, ResultsFile, device_name, file_name

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


def main() -> int:
    """Measures what the command line asks for; returns 1 if a job failed, else 0."""
    arguments = _arguments()
    path = arguments.out / file_name("serving", device_name())
    book = ResultsFile(path, "serving", vars(arguments))
    cases: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for setting in settings(arguments):
            cases.append(measure(setting, arguments, Path(scratch)))
            sys.stdout.write(f"{line(cases[-1])}\n")
            sys.stdout.flush()
            with book.changing() as results:
                results["cases"] = cases
    return int(any("failed" in case for case in cases))


def settings(arguments: argparse.Namespace) -> Iterator[Setting]:
    """All combinations; the environments of a task are split over its simulators."""
    for task in arguments.tasks:
        for backend in arguments.backends:
            for simulators in arguments.simulators:
                yield Setting(task, backend, simulators, arguments.envs // simulators)


def measure(setting: Setting, arguments: argparse.Namespace, scratch: Path) -> dict[str, Any]:
    """Both templates in turn, as often as wanted; a case of the file.

    Throughputs and times are medians over the repeats; every repeat's summary is kept.
    """
    runs: dict[str, list[Summary]] = {"tcg": [], "tdg": []}
    for repeat in range(arguments.repeats):
        for template in arguments.templates:
            name = f"{setting.name.replace(', ', ' ').replace(' ', '-')}-{template}-{repeat}"
            try:
                runs[template].append(serve(setting, template, arguments, scratch, name))
            except RuntimeError as error:
                sys.stderr.write(f"{setting.name}, {template}: {error}\n")
                return {"name": setting.name, "failed": str(error)}
    first = next(found[0] for found in runs.values() if found)
    case: dict[str, Any] = {"name": setting.name, **setting._asdict(), "impl": first.get("impl")}
    case["runs"] = runs
    for template, name in (("tcg", "colocated"), ("tdg", "dedicated")):
        if runs[template]:
            case[name] = statistics.median(run["step_per_s_inference"] for run in runs[template])
    if runs["tdg"]:
        stages = {
            name: statistics.median(run["stages_ms"][name]["p50"] / 1e3 for run in runs["tdg"])
            for name in ("simulate", "infer", "exchange")
        }
        case |= {
            "simulator_s": stages["simulate"],
            "agent_s": stages["infer"],
            # Pipes, copies between host and device, and waiting for the agent's turn.
            "com_s": stages["exchange"] - stages["infer"],
        }
    return case


def serve(
    setting: Setting, template: str, arguments: argparse.Namespace, scratch: Path, name: str
) -> Summary:
    """Runs one job; returns its summary. Raises RuntimeError with what it said if it fails."""
    gmis = setting.simulators + (template == "tdg")
    steps = setting.simulators * setting.num_envs * arguments.unroll_length * arguments.unrolls
    done = subprocess.run(
        [
            *(sys.executable, "-m", "gmijax.serve", f"env={setting.task}", "policy=random"),
            *(f"num_envs={setting.num_envs}", f"num_timesteps={steps}"),
            *(f"unroll_length={arguments.unroll_length}", f"plan.gmis_per_gpu={gmis}"),
            *(f"plan.template={template}", f"plan.backend={setting.backend}"),
            *(f"physics.impl={arguments.impl}", f"run.name={name}"),
        ],
        cwd=scratch,
        env=_environment(),
        check=False,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    if done.returncode != 0:
        said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise RuntimeError(said[-1])
    return json.loads((scratch / "runs" / name / "summary.json").read_text())


def line(case: Mapping[str, Any]) -> str:
    """One case for people."""
    if "failed" in case:
        return f"{case['name']:36} failed: {case['failed']}"
    parts = [f"{case['name']:36}"]
    found = [key for key in ("colocated", "dedicated") if key in case]
    parts += [f"{key} {case[key]:12,.0f} env steps/s" for key in found]
    if "colocated" in case and "dedicated" in case:
        parts.append(f"ratio {case['colocated'] / case['dedicated']:.2f}")
    if "com_s" in case:
        stages = (case[key] * 1e3 for key in ("simulator_s", "agent_s", "com_s"))
        parts.append("T_s {:.3f} T_a {:.3f} COM {:.3f} ms".format(*stages))
    return "  ".join(parts)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=["ant", "humanoid"], metavar="TASK")
    parser.add_argument("--backends", nargs="+", default=["auto"], metavar="BACKEND")
    parser.add_argument("--templates", nargs="+", default=["tcg", "tdg"], choices=["tcg", "tdg"])
    parser.add_argument("--simulators", nargs="+", type=int, default=[1, 2, 4], metavar="M")
    parser.add_argument("--envs", type=int, default=8192, help="environments of all GMIs together")
    parser.add_argument("--impl", default="auto", choices=["auto", "jax", "warp"])
    parser.add_argument("--unroll-length", type=int, default=32)
    parser.add_argument("--unrolls", type=int, default=20, help="unrolls of every GMI")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    return parser.parse_args()


def _environment() -> dict[str, str]:
    checkout = str(Path(__file__).resolve().parent.parent)
    path = os.pathsep.join(filter(None, (checkout, os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path}


if __name__ == "__main__":
    sys.exit(main())
