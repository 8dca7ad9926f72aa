"""One training of a comparison: its command, its environment, and what it left behind."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.peers.comparisons import (
    BRAX,
    COMPARISONS,
    FAST_TD3,
    MJLAB,
    OURS,
    REPORTS,
    brax_training,
    case_name,
    mjlab_training,
)
from benchmarks.peers.fast_td3_flags import fast_td3_training
from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.runs.history import read_metrics

_ROOT = Path(__file__).parents[2]
_MODULES: Mapping[str, str] = {BRAX: "brax_ppo", MJLAB: "mjlab_ppo", FAST_TD3: "fast_td3"}
_WARM_REPORTS = 2  # The second part of a run by Brax may be compiled once more.
_WARM_MEMORY = 0.05  # Of the GPU, for each of ours that compile at the same time.
_SCRIPT_FLAGS: Mapping[str, str] = {
    "gmijax": "--xla_gpu_graph_min_graph_size=1",
    "brax": "--xla_gpu_graph_min_graph_size=1",
    "playground": "--xla_gpu_triton_gemm_any=True",
}
"""Flags of XLA that Brax's and Playground's training scripts set; Brax's too for tasks of ours."""

_OF_FAST_TD3: Mapping[str, str] = {
    "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    "JAX_DEFAULT_MATMUL_PRECISION": "highest",
    "OMP_NUM_THREADS": "1",
    # PyTorch 2.11 cannot compile how observations are normalised: Triton refuses the kernel.
    "TORCHINDUCTOR_PERSISTENT_REDUCTIONS": "0",
}
"""What its script sets, too late for a process that has imported JAX and PyTorch; and a kind of
kernel that PyTorch's compiler is to leave out."""


class Side(NamedTuple):
    """A comparison's training by one of the two libraries.

    Attributes:
      comparison: its name.
      trainer: `OURS`, or the comparison's `peer`.
      more: overrides of the command line, behind those of the comparison.
      where: interpreter of an environment with mjlab, or folder of a checkout of FastTD3.
    """

    comparison: str
    trainer: str
    more: tuple[str, ...] = ()
    where: str = ""

    def __str__(self) -> str:
        return case_name(self.comparison, self.trainer)

    @property
    def settings(self) -> Any:
        """All settings of the training: our command, or the arguments of the other library."""
        if self.trainer == OURS:
            return shlex.join(["python", "-m", "gmijax.train", *self._overrides])
        return self._training(seed=0)

    def command(self, folder: Path, seed: int) -> list[str]:
        """The whole training; leaves its files in `folder`, which is there."""
        if self.trainer == OURS:
            return self._train(folder, f"seed={seed}")
        return self._by_peer(folder, self._training(seed=seed))

    def short_command(self, folder: Path, *, has_gpu: bool) -> list[str]:
        """A short training with the same programs."""
        if self.trainer == OURS:
            memory = (f"plan.memory_fraction={_WARM_MEMORY}",) if has_gpu else ()
            return self._train(folder, "num_timesteps=1", *memory)
        return self._by_peer(folder, self._training(seed=0, is_short=True))

    def variables(self, cache: Path, *, is_short: bool) -> dict[str, str]:
        """Of the environment; `cache` keeps compiled programs, unless the user has one."""
        folder = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(cache))
        variables = {"JAX_COMPILATION_CACHE_DIR": folder}
        if self.trainer == MJLAB:
            variables["PYTHONPATH"] = str(_ROOT)  # Not with the packages of this environment.
        if self.trainer == FAST_TD3:
            variables |= _OF_FAST_TD3
        if self.trainer == BRAX:
            suite = COMPARISONS[self.comparison].suite
            variables |= variables_of_brax(suite)
            if is_short:
                variables["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
        return variables

    def curve(self, folder: Path) -> list[tuple[float, int]]:
        """Seconds and environment steps by then, of a run that has ended."""
        if self.trainer == OURS:
            lines = read_metrics(RunPaths(folder / "run").metrics)
            return [(line["wall_s"], line["env_steps"]) for line in lines]
        return [(seconds, steps) for seconds, steps in read_json(folder / "out.json")["curve"]]

    def returns(self, folder: Path) -> list[tuple[float, float]]:
        """Seconds, as in `curve`, and mean return of the latest episodes; empty: not recorded."""
        if self.trainer == OURS:
            lines = read_metrics(RunPaths(folder / "run").metrics)
            points = [(line["wall_s"], line.get("return")) for line in lines]
            return [(seconds, one) for seconds, one in points if one is not None]
        return read_json(folder / "out.json").get("returns", [])

    @property
    def _overrides(self) -> tuple[str, ...]:
        one = ("plan.gpus=1", "plan.gmis_per_gpu=1")
        return (*COMPARISONS[self.comparison].overrides, *one, *self.more)

    def _train(self, folder: Path, *more: str) -> list[str]:
        overrides = (*self._overrides, *more, f"run.dir={folder / 'run'}")
        return [sys.executable, "-m", "gmijax.train", *overrides]

    def _training(self, *, seed: int, is_short: bool = False) -> dict[str, Any]:
        """Settings for the process of the other library."""
        comparison = COMPARISONS[self.comparison]
        if self.trainer == MJLAB:
            settings = mjlab_training(comparison, self.more, seed=seed)
            return {**settings, "iterations": 2} if is_short else settings
        if self.trainer == FAST_TD3:
            more = (*self.more, "num_timesteps=1") if is_short else self.more
            settings = fast_td3_training(comparison, more, seed=seed)
            return {**settings, "checkout": self.where}
        reports = _WARM_REPORTS if is_short else REPORTS
        return brax_training(comparison, self.more, reports=reports, seed=seed)._asdict()

    def _by_peer(self, folder: Path, training: dict[str, Any]) -> list[str]:
        write_json(folder / "in.json", training)
        files = (str(folder / name) for name in ("in.json", "out.json"))
        python = self.where if self.trainer == MJLAB else sys.executable
        return [python, "-m", f"benchmarks.peers.{_MODULES[self.trainer]}", *files]


def variables_of_brax(suite: str) -> dict[str, str]:
    """Of the environment, for a run by Brax's PPO, as the training script of `suite` sets them."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {_SCRIPT_FLAGS[suite]}"
    variables = {
        "XLA_FLAGS": flags.strip(),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",  # As our jobs do.
    }
    if suite == "playground":
        variables["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    return variables
