"""What a learner beside its agents gains: `python -m benchmarks.off_policy env=ant num_envs=4096`.

SAC on one GPU in two ways: agents and learner in turn in one program, as `algo=sac` trains, and in
two GMIs at the same time. The two GMIs exchange neither experience nor weights: this is what the
GPU allows before anything is moved. Each acts or learns as fast as it can (`free`), or waits for
the other so that the ratio of updates to steps is that of one program (`held`). The learner draws
from a full replay. Adds a call to `benchmarks/results/off-policy-<task>-<device>.json`: rounds
(steps of all environments) and updates of the critics per second.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import gmijax
from benchmarks.records import ResultsFile, device_name, file_name
from benchmarks.runner import exit_code, options
from gmijax.config import SacConfig
from gmijax.errors import ConfigError

LEAD = 2
"""Iterations that one of two GMIs may be ahead of the other where the ratio is held."""


class Alternating(gmijax.Role):
    """One GMI: both in turn in one program, then each alone."""

    def run(self, overrides: tuple[str, ...], window_s: float) -> dict[str, float]:
        """Iterations per second of each."""
        from benchmarks.off_policy_programs import Programs

        programs = Programs(overrides)
        steps = {"both": programs.both, "act": programs.act, "learn": programs.learn}
        return {name: free_rate(self, step, window_s) for name, step in steps.items()}


class Beside(gmijax.Role):
    """One of two GMIs: the first acts, the second learns."""

    def run(self, overrides: tuple[str, ...], window_s: float) -> dict[str, float]:
        """Iterations per second of this one, free and with the ratio held."""
        from benchmarks.off_policy_programs import Programs

        programs = Programs(overrides)
        step = programs.act if self.rank == 0 else programs.learn
        free = free_rate(self, step, window_s)
        rates = self.collective(np.eye(2)[self.rank] * free, "sum")
        count = max(LEAD + 1, int(window_s * min(rates)))  # The same on both: none waits in vain.
        return {"free": free, "held": held_rate(self, step, count)}


def free_rate(role: gmijax.Role, step: Callable[[], None], window_s: float) -> float:
    """Iterations per second in a window that all GMIs begin together."""
    for _ in range(3):
        step()
    role.collective(0.0)
    started_s, count = time.monotonic(), 0
    while time.monotonic() - started_s < window_s:
        step()
        count += 1
        role.progress(count)
    return count / (time.monotonic() - started_s)


def held_rate(role: gmijax.Role, step: Callable[[], None], count: int) -> float:
    """The same of `count` iterations, no more than `LEAD` of them ahead of the other GMI."""
    other, heard = 1 - role.rank, 0
    role.collective(0.0)
    started_s = time.monotonic()
    for done in range(1, count + 1):
        step()
        role.send(done, other)
        while done - heard >= LEAD:
            heard = role.recv(other)
    return count / (time.monotonic() - started_s)


def measured(given: argparse.Namespace, config: Any, backend: str) -> dict[str, Any]:
    """One repeat: rates of both ways, and how the second compares."""
    overrides, per_iteration = tuple(given.overrides), config.algo.unroll_length
    one = gmijax.plan(gmis_per_gpu=1)
    two = gmijax.plan(gmis_per_gpu=2, backend=backend)
    with tempfile.TemporaryDirectory() as folder:
        [alone] = gmijax.launch(
            one, Alternating(), overrides, given.window_s, run_dir=f"{folder}/one"
        )
        agent, learner = gmijax.launch(
            two, Beside(), overrides, given.window_s, run_dir=f"{folder}/two"
        )
    updates = per_iteration * config.algo.updates_per_step
    held = min(agent["held"], learner["held"])
    return {
        "backend": backend,
        "in_turn": {
            "rounds_per_s": per_iteration * alone["both"],
            "updates_per_s": updates * alone["both"],
            "acting_alone_rounds_per_s": per_iteration * alone["act"],
            "learning_alone_updates_per_s": updates * alone["learn"],
        },
        "two_gmis": {
            "free_rounds_per_s": per_iteration * agent["free"],
            "free_updates_per_s": updates * learner["free"],
            "held_rounds_per_s": per_iteration * held,
            "held_updates_per_s": updates * held,
        },
        "gain": {
            "rounds_free": agent["free"] / alone["both"],
            "updates_free": learner["free"] / alone["both"],
            "held": held / alone["both"],
        },
    }


def summary(repeats: list[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Medians of the gains, by backend."""
    by_backend: dict[str, dict[str, float]] = {}
    for backend in dict.fromkeys(one["backend"] for one in repeats):
        gains = [one["gain"] for one in repeats if one["backend"] == backend]
        by_backend[backend] = {
            name: statistics.median(g[name] for g in gains) for name in gains[0]
        }
    return by_backend


def main() -> int:
    """Measures what the command line asks for."""
    parser = options("off_policy", __doc__)
    parser.add_argument("overrides", nargs="+", help="of the training, e.g. env=ant num_envs=4096")
    parser.add_argument("--window-s", type=float, default=4.0, help="seconds of a measurement")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--backends", nargs="+", default=["auto"], help="of the two GMIs")
    given = parser.parse_intermixed_args()
    given.overrides = ["algo=sac", *given.overrides]
    config = gmijax.compose(*given.overrides)
    if not isinstance(config.algo, SacConfig):
        raise ConfigError(f"algo={config.algo.name}: must be sac here")
    path = Path(given.out) / file_name(f"off-policy-{config.env.slug}", device_name())
    file = ResultsFile(path, "off_policy", vars(given))
    repeats: list[Mapping[str, Any]] = []
    for _ in range(given.repeats):
        for backend in given.backends:
            repeats.append(measured(given, config, backend))
            with file.changing() as results:
                results.update(repeats=repeats, summary=summary(repeats))
    for backend, gains in summary(repeats).items():
        shown = ", ".join(f"{name} {gain:.2f}x" for name, gain in gains.items())
        sys.stdout.write(f"{backend}: {shown} of one program, medians of {given.repeats}\n")
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
