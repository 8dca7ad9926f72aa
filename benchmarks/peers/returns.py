"""What Brax's PPO learns on Playground's tasks: `python -m benchmarks.peers.returns CheetahRun`.

Every task is trained with `tuned=dm_control_ppo`, as `benchmarks.seeds` trains it by gmijax.
Returns are those of the latest 100 episodes of the training, as ours are. All runs go on at once,
so their speed says nothing. Adds a call to `benchmarks/results/brax-returns-<device>.json`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.peers.comparisons import Comparison, brax_training
from benchmarks.peers.side import variables_of_brax
from benchmarks.records import results_file
from benchmarks.runner import Command, deadline, exit_code, failures_of, options
from gmijax.runs.folder import read_json, write_json


def settings_of(task: str, more: tuple[str, ...], seed: int) -> dict[str, Any]:
    """Settings for the process of a run.

    Args:
      task: of Playground.
      more: overrides of the configuration that both libraries share.
      seed: of Brax's random numbers.

    Raises:
      ConfigError: see `brax_training`.
    """
    overrides = ("env=playground", f"env.name={task}", "tuned=dm_control_ppo", "physics.impl=warp")
    training = brax_training(Comparison(overrides, unrolls=16), more, seed=seed)
    return training._replace(
        arguments={**training.arguments, "log_training_metrics": True}
    )._asdict()


def train(tasks: dict[str, dict[str, Any]], root: Path, timeout_s: float) -> dict[str, Any]:
    """Trains all at once; of each the returns by steps, up to where it failed, and why it did."""
    commands = []
    for name, training in tasks.items():
        folder = root / name
        folder.mkdir()
        write_json(folder / "in.json", training)
        files = (str(folder / file) for file in ("in.json", "out.json"))
        words = [sys.executable, "-m", "benchmarks.peers.brax_ppo", *files]
        commands.append(Command(words, folder, variables_of_brax(training["suite"])))
    runs: dict[str, Any] = {}
    for name, failure in zip(tasks, failures_of(commands, deadline(timeout_s)), strict=True):
        out = root / name / "out.json"
        returns = read_json(out)["returns"] if out.exists() else []
        runs[name] = {"returns": returns, **({"failed": failure} if failure else {})}
    return runs


def main() -> int:
    """Trains what the command line asks for; returns 1 if a run failed, else 0."""
    parser = options("peers.returns", __doc__)
    parser.add_argument(
        "tasks", nargs="+", metavar="TASK", help="of Playground's dm_control suite"
    )
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--override", action="append", default=[], help="e.g. num_timesteps=20e6")
    parser.add_argument("--timeout-s", type=float, default=3600.0)
    given = parser.parse_args()
    names = {f"{task}-{seed}": (task, seed) for task in given.tasks for seed in range(given.seeds)}
    more = tuple(given.override)
    tasks = {name: settings_of(task, more, seed) for name, (task, seed) in names.items()}
    file = results_file(given, "brax-returns")
    with tempfile.TemporaryDirectory() as scratch:
        found = train(tasks, Path(scratch), given.timeout_s)
    with file.changing() as results:
        for name, (task, seed) in names.items():
            results.setdefault(task, []).append({"seed": seed, **found[name]})
    for name, run in found.items():
        sys.stdout.write(f"{name}: {run['returns'][-1:]} {run.get('failed', '')}\n")
    return int(any("failed" in run for run in found.values()))


if __name__ == "__main__":
    sys.exit(exit_code(main))
