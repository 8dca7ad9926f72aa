r"""Seconds until a robot walks: `python -m benchmarks.walking env=go1 --seeds 5`.

Trains with checkpoints on the way, then puts them through the walking test, so that no test costs
training time. A training walks from the first checkpoint on of which two in a row walk. Its
seconds run from the start of the command until the checkpoint is written, and apart from that from
the first step until the policy is there. One whose tests were cut short by `--deadline-s` counts
neither as walking nor as not. Programs, and kernels of MJX-Warp, are compiled before, in a short
training; with `--cold` every training, and the tests, compile all of them.

    python -m benchmarks.walking env=go1 num_timesteps=60e6 --seeds 5
    python -m benchmarks.walking env=g1 --script='--impl=warp --num_timesteps=200000000'

With `--gpus` seeds are trained and tested at the same time, each on a GPU of its own with its part
of the cores.

`--script` trains with Playground's own script (Brax's PPO) too, in turn with ours, with its own
settings but for these flags, with the first `--script-seeds` of the seeds. Its short training has
as many steps as it makes between two evaluations: their number is part of its program. Adds a call
to `benchmarks/results/walking-<task>-<device>.json`.
"""

from __future__ import annotations

import argparse
import math
import shlex
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import gmijax
from benchmarks.free_gpus import Part, on_parts
from benchmarks.peers.side import variables_of_brax
from benchmarks.records import results_file
from benchmarks.runner import deadline, exit_code, in_turn, options, run_command
from gmijax.config import TrainConfig
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import detect_machine
from gmijax.player.joystick import robot_of
from gmijax.player.walking import LEAST_ENVS, NUM_ENVS
from gmijax.runs.checkpoints import CheckpointMeta, checkpoints_of
from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.runs.history import read_metrics
from gmijax.sim.robots import playground_name, robot_name

OURS, SCRIPT = "gmijax", "train-jax-ppo"
BRAX_CONFIG = "ppo_network_config.json"
"""What Brax's PPO writes into every checkpoint beside the weights."""


class Benchmark:
    """The trainings of one call, in its file after each of them."""

    def __init__(self, given: argparse.Namespace, config: TrainConfig, scratch: Path) -> None:
        self._given, self._config, self._scratch = given, config, scratch
        self._deadline_s = deadline(given.deadline_s)
        self._trained_by_s = self._deadline_s - given.reserve_s
        self._machine = detect_machine()
        self.file = results_file(given, "walking", f"-{config.env.slug}", gpus=1)
        self._script_seeds = given.seeds if given.script_seeds is None else given.script_seeds
        self.runs: list[dict[str, Any]] = []
        self._codes_of_tests: list[int] = []

    @property
    def has_failed(self) -> bool:
        """Whether a training of ours or the tests failed; the script may fail at its film."""
        ours = [run["code"] for run in self.runs if run["trainer"] == OURS]
        return any(ours) or any(self._codes_of_tests)

    def run(self) -> None:
        """Trains with all seeds, tests, and writes both down."""
        trainers = [OURS] if self._given.script is None else [OURS, SCRIPT]
        count = max(1, min(self._given.gpus, len(self._machine.gpus), self._given.seeds))
        if not self._given.cold:
            for trainer in trainers:
                self._train(trainer, "compile", Part(), is_short=True)

        def seeds_of(number: int, part: Part) -> None:
            self._seeds(str(number), trainers, range(number, self._given.seeds, count), part)

        on_parts(self._machine, count, range(count), seeds_of)
        self._write()

    def _seeds(self, name: str, trainers: Sequence[str], seeds: Sequence[int], part: Part) -> None:
        """Trains with these seeds, then tests what came of them."""
        mine: list[dict[str, Any]] = []
        for number, trainer in in_turn(trainers, len(seeds), self._trained_by_s):
            seed = seeds[number]
            if trainer == SCRIPT and seed >= self._script_seeds:
                continue
            run = {"trainer": trainer, "seed": seed, **self._train(trainer, str(seed), part)}
            mine.append(run)
            self.runs.append(run)
            self._write()
        self._test(name, mine, part)

    def _train(
        self, trainer: str, name: str, part: Part, *, is_short: bool = False
    ) -> dict[str, Any]:
        """One training as a whole command, and its checkpoints."""
        folder = self._scratch / f"{trainer}-{name}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise ConfigError(f"--runs={self._given.runs}: has a {folder.name} already") from None
        cache = folder if self._given.cold else self._scratch
        variables = {**part.variables, **_caches(cache)}
        if trainer == OURS:
            command = self._our_command(folder, name, is_short=is_short)
        else:
            command = self._script_command(folder, name, is_short=is_short)
            variables |= variables_of_brax("playground")
        started_s = time.time()
        code = run_command([*part.prefix, *command], self._trained_by_s, variables)
        command_s = time.time() - started_s
        found = _ours(folder, started_s) if trainer == OURS else _theirs(folder, started_s)
        if trainer == SCRIPT and not found:
            self._refuse_a_script_that_cannot_train()
        checkpoints = apart(found)
        for one in checkpoints:  # Environments take hundreds of MB; only policies are tested.
            for environments in Path(one["folder"]).glob("gmi_*"):
                shutil.rmtree(environments)
        return {"code": code, "command_s": command_s, "checkpoints": checkpoints}

    def _refuse_a_script_that_cannot_train(self) -> None:
        """Raises ConfigError if its first training left nothing although there was time.

        Its exit code is no sign: it may fail at its film.
        """
        is_first = all(run["trainer"] != SCRIPT for run in self.runs)
        if is_first and time.monotonic() < self._trained_by_s:
            raise ConfigError("--script: left no checkpoint, see above")

    def _our_command(self, folder: Path, seed: str, *, is_short: bool) -> list[str]:
        config = self._config
        assert isinstance(config.num_envs, int)
        per_iteration = config.num_envs * getattr(config.algo, "unroll_length", 1)
        every = max(1, config.num_timesteps // per_iteration // self._given.tests)
        overrides = [
            *("plan.gpus=1", "plan.gmis_per_gpu=1"),
            *(f"run.checkpoint_every={every}", "run.keep_checkpoints=null"),
            *(*self._given.overrides, f"run.dir={folder / 'run'}"),
            "num_timesteps=1" if is_short else f"seed={seed}",
        ]
        return [sys.executable, "-m", "gmijax.train", *overrides]

    def _script_command(self, folder: Path, seed: str, *, is_short: bool) -> list[str]:
        given = [f"--num_evals={self._given.tests + 1}", *shlex.split(self._given.script)]
        flags = [
            f"--env_name={playground_name(str(self._config.env.name))}",
            *(f"--logdir={folder}", "--num_videos=1", *given),
            *(self._short_flags(given) if is_short else (f"--seed={seed}",)),
        ]
        return [sys.executable, "-m", "benchmarks.peers.playground_script", *flags]

    def _short_flags(self, given: Sequence[str]) -> tuple[str, ...]:
        """Of one part of the script's training: of as many steps as each of them has."""
        flags = script_flags(given)
        shipped = gmijax.compose(f"env={robot_name(str(self._config.env.name))}")
        steps = flags.num_timesteps or shipped.num_timesteps
        parts = max(1, flags.num_evals - 1)
        return f"--num_timesteps={math.ceil(steps / parts)}", "--num_evals=2"

    def _test(self, name: str, mine: Sequence[dict[str, Any]], part: Part) -> None:
        """All checkpoints of these trainings, in a process of their own."""
        given = self._given
        asked, out = (self._scratch / f"{kind}-{name}.json" for kind in ("tests", "walks"))
        config = {
            "env": to_dict(self._config.env),
            "num_envs": given.envs,
            "seed": given.test_seed,
            "runs": [[one["folder"] for one in run["checkpoints"]] for run in mine],
            "impls": [self._impl(run["trainer"]) for run in mine],
        }
        write_json(asked, config)
        module = [sys.executable, "-m", "benchmarks.walking_tests"]
        command = [*part.prefix, *module, str(asked), str(out)]
        variables = {**part.variables, **_caches(self._scratch)}
        code = run_command(command, self._deadline_s, variables)
        self._codes_of_tests.append(code)
        found = read_json(out)["walks"] if out.exists() else [[] for _ in mine]
        for run, walks in zip(mine, found, strict=True):
            for checkpoint, walk in zip(run["checkpoints"], walks, strict=False):
                checkpoint["walk"] = walk
            run["walks_from"] = walks_from(run["checkpoints"])

    def _impl(self, trainer: str) -> str:
        """What a trainer was asked for as physics."""
        if trainer == OURS:
            return self._config.physics.impl
        return script_flags(shlex.split(self._given.script)).impl

    def _write(self) -> None:
        runs = [
            {**run, "checkpoints": [_without_folder(one) for one in run["checkpoints"]]}
            for run in sorted(self.runs, key=lambda run: run["seed"])
        ]
        with self.file.changing() as results:
            results.update(task=self._config.env.label, runs=runs)


def script_flags(given: Sequence[str]) -> argparse.Namespace:
    """Those of the script's flags that are wanted here, with its defaults (Playground 0.2.0)."""
    parser = argparse.ArgumentParser(allow_abbrev=False, add_help=False)
    parser.add_argument("--num_timesteps", type=lambda text: int(float(text)))
    parser.add_argument("--num_evals", type=int)
    parser.add_argument("--impl", default="jax")
    return parser.parse_known_args(given)[0]


def apart(checkpoints: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Without a last one soon after the one before: to test it would be to test that one twice."""
    steps = [one["env_steps"] for one in checkpoints]
    if len(steps) > 2 and 2 * (steps[-1] - steps[-2]) < steps[1] - steps[0]:
        return checkpoints[:-1]
    return checkpoints


def walks_from(checkpoints: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """The checkpoint from which on a training walks, None without one; see the module."""
    tested = [one for one in checkpoints if "walk" in one]
    for one, after in pairwise(tested):
        if one["walk"]["walks"] and after["walk"]["walks"]:
            return {key: value for key, value in _without_folder(one).items() if key != "walk"}
    return None


def _without_folder(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in checkpoint.items() if key != "folder"}


def is_tested(run: Mapping[str, Any]) -> bool:
    """Whether the tests of a training were enough to decide whether it walks.

    The deadline may have ended them.
    """
    return bool(run.get("walks_from")) or all("walk" in one for one in run["checkpoints"])


def summary(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Of each trainer: how many trainings walk, and least, median and most of when they do.

    `seeds` are those that are tested, `untested` the others.
    """
    rows: dict[str, Any] = {}
    for trainer in dict.fromkeys(run["trainer"] for run in runs):
        trained = [run for run in runs if run["trainer"] == trainer]
        mine = [run for run in trained if is_tested(run)]
        walking = [run["walks_from"] for run in mine if run.get("walks_from")]
        spread = {
            key: _spread([one[key] for one in walking])
            for key in ("env_steps", "command_s", "training_s")
        }
        counts = {"seeds": len(mine), "walk": len(walking), "untested": len(trained) - len(mine)}
        rows[trainer] = counts | spread
    return rows


def _spread(values: Sequence[float | None]) -> list[float] | None:
    known = [value for value in values if value is not None]
    return [min(known), statistics.median(known), max(known)] if known else None


def _ours(folder: Path, started_s: float) -> list[dict[str, Any]]:
    """Checkpoints of a run of ours, the fewest steps first, and seconds until they were there."""
    run = RunPaths(folder / "run")
    trained = {line["env_steps"]: line.get("wall_s") for line in read_metrics(run.metrics)}
    metas = [(path, CheckpointMeta.read(path)) for path in checkpoints_of(run.root)]
    return [
        {
            "folder": str(path),
            "env_steps": meta.env_steps,
            "command_s": None if meta.time_s is None else meta.time_s - started_s,
            "training_s": trained.get(meta.env_steps),
        }
        for path, meta in metas
    ]


def _theirs(folder: Path, started_s: float) -> list[dict[str, Any]]:
    """As `_ours`, of Playground's script, which does not record when it made its first step."""
    found = sorted(folder.glob(f"*/checkpoints/*/{BRAX_CONFIG}"))
    return [
        {
            "folder": str(path.parent),
            "env_steps": int(path.parent.name),
            "command_s": path.stat().st_mtime - started_s,
            "training_s": None,
        }
        for path in found
    ]


def _caches(folder: Path) -> dict[str, str]:
    """Where programs and kernels of MJX-Warp are kept: in this folder."""
    of = {"JAX_COMPILATION_CACHE_DIR": "xla", "WARP_CACHE_PATH": "warp"}
    return {name: str(folder / kept) for name, kept in of.items()}


def main() -> int:
    """Measures what the command line asks for; returns 1 if some of it failed, else 0."""
    given = _options()
    config = gmijax.compose(*given.overrides)
    if robot_of(config.env) is None:
        raise ConfigError(f"env={config.env.label}: has no walking test")
    if given.envs < LEAST_ENVS:
        raise ConfigError(f"--envs={given.envs}: must be at least {LEAST_ENVS}")
    if given.script_seeds is not None and (
        given.script is None or not 1 <= given.script_seeds <= given.seeds
    ):
        allowed = f"needs --script, and is 1 to --seeds={given.seeds}"
        raise ConfigError(f"--script-seeds={given.script_seeds}: {allowed}")
    if not isinstance(config.num_envs, int):
        raise ConfigError(f"num_envs={config.num_envs}: must be a number here")
    with tempfile.TemporaryDirectory() as scratch:
        benchmark = Benchmark(given, config, (given.runs or Path(scratch)).absolute())
        benchmark.run()
    for trainer, row in summary(benchmark.runs).items():
        sys.stdout.write(f"{trainer}: {row}\n")
    return int(benchmark.has_failed)


def _options() -> argparse.Namespace:
    parser = options("walking", __doc__)
    parser.add_argument("overrides", nargs="*", help="of our trainings, e.g. env=go1")
    parser.add_argument("--seeds", type=int, default=5, help="trainings of each kind")
    parser.add_argument("--gpus", type=int, default=1, help="for seeds at the same time")
    parser.add_argument("--tests", type=int, default=20, help="checkpoints of a training")
    parser.add_argument("--envs", type=int, default=NUM_ENVS, help="environments of a test")
    parser.add_argument("--test-seed", type=int, default=0, help="of the test's starts")
    parser.add_argument("--cold", action="store_true", help="compile in every training")
    parser.add_argument("--script", help="train with Playground's script too, with these flags")
    parser.add_argument("--script-seeds", type=int, help="trainings by it; default: --seeds")
    parser.add_argument("--deadline-s", type=float, help="seconds for all of it")
    parser.add_argument("--reserve-s", type=float, default=150.0, help="of these, for the tests")
    parser.add_argument("--runs", type=Path, help="keep the trainings here, without environments")
    return parser.parse_intermixed_args()


if __name__ == "__main__":
    sys.exit(exit_code(main))
