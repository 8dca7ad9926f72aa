r"""Trains the policies that gmijax ships: `python -m benchmarks.shipped`.

All tasks are trained at the same time on one GPU, each with its tuned settings but for those of
`RECIPES`. The checkpoint with the best evaluation becomes `gmijax/player/policies/<task>.npz`,
its weights in float16. `benchmarks/results/shipped-<device>.json` says what it was made with and
what it returns: in MJX, as evaluated while it was trained (128 episodes with float32 weights), and
in plain MuJoCo, as the file is.

    python -m benchmarks.shipped --deadline-s 470

`--only-evaluate` leaves the policies as they are and plays them in plain MuJoCo again.
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.command import start, wait_until
from benchmarks.records import RESULTS, ResultsFile, device_name, file_name
from gmijax.machine.mps_control import DEFAULT_PIPE_DIRECTORY, MpsControl
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.player.policy import read_policy, write_policy
from gmijax.player.returns import Played, play
from gmijax.player.shipped import POLICIES
from gmijax.runs.folder import POLICY, RunPaths, read_json
from gmijax.runs.history import read_metrics
from gmijax.runs.resume import CheckpointMeta, best_checkpoint

SEED = 0
MEMORY = 0.65
"""Of the GPU's, which trainings reserve together; MJX-Warp takes more beside it."""

AT_ONCE = 8
"""Episodes in plain MuJoCo that a process plays one after the other."""

OF_SUMMARY = ("status", "wall_s", "train_wall_s", "compile_s", "env_steps_per_s", "impl", "device")

THROUGH = (0, 130)
"""Exit codes of trainings that have saved, the last one at the deadline."""

EVALUATIONS = 5
"""Of a training; the best one's checkpoint is shipped."""


class Recipe(NamedTuple):
    """How a policy is trained: environment steps, and what is not as it is tuned."""

    steps: int
    overrides: Sequence[str] = ()


RECIPES: Mapping[str, Recipe] = {
    "ant": Recipe(40_000_000),
    "anymal": Recipe(40_000_000),
    "ball_balance": Recipe(12_000_000, ("num_envs=4096",)),
    "franka_cabinet": Recipe(30_000_000),
    "humanoid": Recipe(60_000_000),
    # A file of the tuned network would be six times as large.
    "shadow_hand": Recipe(100_000_000, ("algo.policy_hidden_layer_sizes=[256,256,128]",)),
}


def main() -> int:
    """Trains and evaluates; returns 1 if a training failed."""
    given = _arguments()
    path = given.out / file_name("shipped", device_name())
    file = ResultsFile(path, "shipped", vars(given))
    code = 0
    if not given.only_evaluate:
        with tempfile.TemporaryDirectory() as scratch:
            code = train(given, given.runs or Path(scratch), file)
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        for task in given.tasks:
            evaluate(task, given, file, pool)
    return code


def train(given: argparse.Namespace, runs: Path, file: ResultsFile) -> int:
    """Trains all at once, and keeps the policies of those that are through."""
    deadline_s = time.monotonic() + given.deadline_s
    runs.mkdir(parents=True, exist_ok=True)
    with _shared_gpu(detect_machine(), runs) as own:
        started = []
        for task in given.tasks:
            with (runs / f"{task}.log").open("wb") as log:
                started.append(start(command(task, given, runs, own), {}, log))
        codes = wait_until(deadline_s, *started)
    for task, code in zip(given.tasks, codes, strict=True):
        if code in THROUGH:
            keep(task, code, runs / task, given, file)
        else:
            sys.stdout.write(f"{task}: failed (exit code {code}), see {runs / task}.log\n")
            sys.stdout.write((runs / f"{task}.log").read_text(errors="replace")[-2000:])
    return int(any(code not in THROUGH for code in codes))


def command(task: str, given: argparse.Namespace, runs: Path, own: Sequence[str]) -> Sequence[str]:
    """The training of a task."""
    recipe = RECIPES[task]
    steps = max(1, int(recipe.steps * given.scale))
    return [
        *(sys.executable, "-m", "gmijax.train", f"env={task}", f"num_timesteps={steps}"),
        *(f"seed={SEED}", f"run.dir={runs / task}", "run.measure_throughput=false"),
        *(f"eval.every={-(-steps // EVALUATIONS)}", "run.checkpoint_every=0"),
        *(*recipe.overrides, *own, *given.overrides),
    ]


@contextmanager
def _shared_gpu(machine: Machine, runs: Path) -> Iterator[Sequence[str]]:
    """Keys for trainings that share a GPU, under one MPS daemon where there is one to start."""
    if not machine.gpus:
        yield []
        return
    share = f"plan.memory_fraction={MEMORY / len(RECIPES):.2f}"
    gpu = machine.gpus[0]
    if machine.mps_control is None:
        yield [share, "plan.backend=share"]
        return
    if machine.daemon_of(gpu.uuid) is not None:
        yield [share, "plan.backend=mps"]
        return
    daemon = MpsControl(machine.mps_control, DEFAULT_PIPE_DIRECTORY)
    daemon.start(gpu.uuid, runs / "mps")
    try:
        yield [share, "plan.backend=mps"]
    finally:
        daemon.quit()


def keep(
    task: str, code: int, run_dir: Path, given: argparse.Namespace, file: ResultsFile
) -> None:
    """Ships the best checkpoint of a run, and writes down where it is from."""
    best = best_checkpoint(run_dir)
    if best is None:
        sys.stdout.write(f"{task}: no checkpoint\n")
        return
    steps = CheckpointMeta.read(best).env_steps
    evaluations = [
        {"env_steps": line["env_steps"], "return": line["eval/return"], **_of(line)}
        for line in read_metrics(RunPaths(run_dir).metrics)
        if "eval/return" in line
    ]
    summary = read_json(RunPaths(run_dir).summary)
    policy = read_policy(best / POLICY)
    about = {**policy.about, "device": device_name(), "train_wall_s": summary.get("train_wall_s")}
    given.policies.mkdir(parents=True, exist_ok=True)
    path = given.policies / f"{task}.npz"
    write_policy(path, dataclasses.replace(policy, about=about), half=True)
    with file.changing() as results:
        results[task] = {
            "overrides": list(command(task, given, Path("runs"), ())[3:]),
            "code": code,
            "env_steps": steps,
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


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="*", help="of all trainings, e.g. physics.impl=jax")
    parser.add_argument("--tasks", nargs="+", default=list(RECIPES), choices=list(RECIPES))
    parser.add_argument("--scale", type=float, default=1.0, help="factor on all steps")
    parser.add_argument("--episodes", type=int, default=128, help="in plain MuJoCo")
    parser.add_argument("--deadline-s", type=float, default=3600.0, help="for the trainings")
    parser.add_argument("--only-evaluate", action="store_true", help="train nothing")
    parser.add_argument("--runs", type=Path, help="keep the run folders here")
    parser.add_argument("--policies", type=Path, default=POLICIES, help="where policies go")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    return parser.parse_intermixed_args()


if __name__ == "__main__":
    sys.exit(main())
