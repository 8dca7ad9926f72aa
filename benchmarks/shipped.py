r"""Trains the policies that gmijax ships: `python -m benchmarks.shipped`.

All tasks are trained at the same time on one GPU, as one sweep, each with its tuned settings but
for those of `RECIPES`. The checkpoint with the best evaluation, or the last one, becomes
`gmijax/player/policies/<task>.npz`, its weights in float16.
`benchmarks/results/shipped-<device>.json` says what it was made with and what it returns: in MJX,
as evaluated while it was trained (128 episodes with float32 weights), and in plain MuJoCo, as the
file is.

    python -m benchmarks.shipped --deadline-s 470

`--only-evaluate` leaves the policies as they are and plays them in plain MuJoCo again.
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.records import ResultsFile, device_name, results_file
from benchmarks.runner import STOP_S, exit_code, options
from gmijax.cli.compose import compose
from gmijax.errors import JobInterrupted, SweepFailed
from gmijax.machine.snapshot import detect_machine
from gmijax.player.policy import read_policy, write_policy
from gmijax.player.returns import Played, play
from gmijax.player.shipped import POLICIES
from gmijax.runs.checkpoints import CheckpointMeta, newest_checkpoint
from gmijax.runs.folder import POLICY, RunPaths, read_json
from gmijax.runs.history import read_metrics
from gmijax.runs.ranking import best_checkpoint
from gmijax.sweeps.sweep import sweep

SEED = 0
SLOTS = 8
"""Of the sweep on the GPU, more than there are tasks: MJX-Warp takes memory beside its slot."""

AT_ONCE = 8
"""Episodes in plain MuJoCo that a process plays one after the other."""

OF_SUMMARY = ("status", "wall_s", "train_wall_s", "compile_s", "env_steps_per_s", "impl", "device")

CODES = {"completed": 0, "interrupted": 130}
"""States of trainings that have saved, the last one at the deadline."""

EVALUATIONS = 5
"""Of a training; the best one's checkpoint is shipped, or the last one."""


class Recipe(NamedTuple):
    """How a policy is trained: environment steps, and what is not as it is tuned.

    `ships_last`: the last checkpoint is taken, not that of the largest return.
    """

    steps: int
    overrides: Sequence[str] = ()
    ships_last: bool = False


RECIPES: Mapping[str, Recipe] = {
    "ant": Recipe(40_000_000),
    "anymal": Recipe(40_000_000),
    "ball_balance": Recipe(12_000_000, ("num_envs=4096",)),
    # An arm that fails to open the drawer goes on earning: the largest return is no success.
    "franka_cabinet": Recipe(30_000_000, ships_last=True),
    "humanoid": Recipe(60_000_000),
    # A file of the tuned network would be six times as large.
    "shadow_hand": Recipe(100_000_000, ("algo.policy_hidden_layer_sizes=[256,256,128]",)),
}


def main() -> int:
    """Trains and evaluates; returns 1 if a training failed."""
    given = _options()
    file = results_file(given, "shipped")
    code = 0
    if not given.only_evaluate:
        with tempfile.TemporaryDirectory() as scratch:
            code = train(given, given.runs or Path(scratch) / "sweep", file)
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        for task in given.tasks:
            evaluate(task, given, file, pool)
    return code


def train(given: argparse.Namespace, root: Path, file: ResultsFile) -> int:
    """Trains all at once, and keeps the policies of those that are through."""
    configs = [compose(*overrides(task, given), f"run.dir={root}") for task in given.tasks]
    # All save and end then. A sweep that has failed jobs has run the others.
    alarm = threading.Timer(given.deadline_s - STOP_S, os.kill, (os.getpid(), signal.SIGTERM))
    alarm.daemon = True
    alarm.start()
    try:
        # Without a GPU, slots would divide the cores.
        slots = SLOTS if detect_machine().gpus else 1
        with suppress(JobInterrupted, SweepFailed):
            sweep(configs, jobs_per_gpu=slots, gpus=1)
    finally:
        alarm.cancel()
    if not (root / "sweep.json").exists():
        sys.stdout.write("the deadline came before the trainings had begun\n")
        return 1
    code = 0
    for task, job in zip(given.tasks, read_json(root / "sweep.json")["jobs"], strict=True):
        if job["state"] in CODES:
            keep(task, CODES[job["state"]], Path(job["run_dir"]), given, file)
        else:
            sys.stdout.write(f"{task}: {job['state']}, see {job['run_dir']}: {job['error']}\n")
            code = 1
    return code


def overrides(task: str, given: argparse.Namespace) -> Sequence[str]:
    """The training of a task."""
    recipe = RECIPES[task]
    steps = max(1, int(recipe.steps * given.scale))
    return [
        *(f"env={task}", f"num_timesteps={steps}", f"seed={SEED}"),
        *(f"eval.every={-(-steps // EVALUATIONS)}", "run.checkpoint_every=0"),
        *(*recipe.overrides, *given.overrides),
    ]


def keep(
    task: str, code: int, run_dir: Path, given: argparse.Namespace, file: ResultsFile
) -> None:
    """Ships a checkpoint of a run, and writes down where it is from."""
    if RECIPES[task].ships_last:
        checkpoint = newest_checkpoint(run_dir).checkpoint
    else:
        checkpoint = best_checkpoint(run_dir)
    if checkpoint is None:
        sys.stdout.write(f"{task}: no checkpoint\n")
        return
    steps = CheckpointMeta.read(checkpoint).env_steps
    lines = [line for line in read_metrics(RunPaths(run_dir).metrics) if "eval/return" in line]
    evaluations = [
        {"env_steps": line["env_steps"], "return": line["eval/return"], **_of(line)}
        for line in lines
    ]
    trained_s = next((line["wall_s"] for line in lines if line["env_steps"] == steps), None)
    summary = read_json(RunPaths(run_dir).summary)
    policy = read_policy(checkpoint / POLICY)
    about = {**policy.about, "device": device_name(), "train_wall_s": trained_s}
    given.policies.mkdir(parents=True, exist_ok=True)
    path = given.policies / f"{task}.npz"
    write_policy(path, dataclasses.replace(policy, about=about), half=True)
    with file.changing() as results:
        results[task] = {
            "overrides": overrides(task, given),
            "code": code,
            "env_steps": steps,
            "trained_s": trained_s,
            **{name: summary.get(name) for name in OF_SUMMARY},
            "bytes": path.stat().st_size,
            "mjx": next((one for one in evaluations if one["env_steps"] == steps), None),
            "evaluations": evaluations,
        }
    sys.stdout.write(f"{task}: {steps} steps, {results[task]['mjx']}\n")


def _of(line: Mapping[str, Any]) -> dict[str, Any]:
    """The rest of an evaluation."""
    names = [name for name in line if name.startswith("eval/") and name != "eval/return"]
    return {name.removeprefix("eval/"): line[name] for name in names}


def evaluate(
    task: str, given: argparse.Namespace, file: ResultsFile, pool: ProcessPoolExecutor
) -> None:
    """Plays a shipped policy in plain MuJoCo."""
    path = given.policies / f"{task}.npz"
    if not path.exists():
        return
    parts = [pool.submit(_play, path, seed) for seed in range(1, 1 + given.episodes // AT_ONCE)]
    found = statistics([episode for part in parts for episode in part.result()])
    with file.changing() as results:
        results.setdefault(task, {})["mujoco"] = found
    sys.stdout.write(f"{task}: in plain MuJoCo {found}\n")


def statistics(episodes: Sequence[Played]) -> dict[str, Any]:
    """Means over episodes, and the spread of their returns."""
    returns = np.array([one.return_ for one in episodes])
    names = episodes[0].metrics
    return {
        "episodes": len(episodes),
        "return": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_quartiles": [float(x) for x in np.quantile(returns, (0.25, 0.5, 0.75))],
        "length": float(np.mean([one.length for one in episodes])),
        "terminated": sum(one.terminated for one in episodes),
        **{name: float(np.mean([one.metrics[name] for one in episodes])) for name in names},
    }


def _play(path: Path, seed: int) -> list[Played]:
    return list(play(read_policy(path), AT_ONCE, seed))


def _options() -> argparse.Namespace:
    parser = options("shipped", __doc__)
    parser.add_argument("overrides", nargs="*", help="of all trainings, e.g. physics.impl=jax")
    parser.add_argument("--tasks", nargs="+", default=list(RECIPES), choices=list(RECIPES))
    parser.add_argument("--scale", type=float, default=1.0, help="factor on all steps")
    parser.add_argument("--episodes", type=int, default=128, help="in plain MuJoCo")
    parser.add_argument("--deadline-s", type=float, default=3600.0, help="for the trainings")
    parser.add_argument("--only-evaluate", action="store_true", help="train nothing")
    parser.add_argument("--runs", type=Path, help="keep the sweep here")
    parser.add_argument("--policies", type=Path, default=POLICIES, help="where policies go")
    return parser.parse_intermixed_args()


if __name__ == "__main__":
    sys.exit(exit_code(main))
