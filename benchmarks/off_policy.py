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
from typing import Any

import numpy as np

import gmijax
from benchmarks.records import results_file
from benchmarks.runner import exit_code, in_turn, options
from gmijax.config import SacConfig, TrainConfig
from gmijax.errors import ConfigError

LEAD = 2
"""Iterations that one of two GMIs may be ahead of the other where the ratio is held."""

_SHOWN = (
    *("batch_size", "updates_per_step", "policy_every", "unroll_length", "replay_steps"),
    *("precision", "replay_precision", "critic_hidden_layer_sizes", "policy_hidden_layer_sizes"),
)


class Alternating(gmijax.Role):
    """One GMI: both in turn in one program, then each alone."""

    def run(self, overrides: tuple[str, ...], window_s: float) -> dict[str, float]:
        """How fast each is, in iterations per second."""
        from benchmarks.off_policy_programs import Programs

        programs = Programs(overrides)
        steps = {"both": programs.both, "act": programs.act, "learn": programs.learn}
        return {name: free_rate(self, step, window_s) for name, step in steps.items()}


class Separate(gmijax.Role):
    """One of two GMIs: the first acts, the second learns."""

    def run(self, overrides: tuple[str, ...], window_s: float) -> dict[str, float]:
        """How fast this one is in iterations per second, free and with the ratio held."""
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
    """Iterations per second of `count`, no more than `LEAD` of them ahead of the other GMI."""
    other, other_done = 1 - role.rank, 0
    role.collective(0.0)
    started_s = time.monotonic()
    for done in range(1, count + 1):
        step()
        role.send(done, other)
        while done - other_done >= LEAD:
            other_done = role.recv(other)
    return count / (time.monotonic() - started_s)


def resolved(config: TrainConfig, algo: SacConfig) -> dict[str, Any]:
    """What was measured, whatever the defaults are by then."""
    drawn = algo.updates_per_step * algo.batch_size / config.envs_per_gmi
    return {
        "num_envs": config.envs_per_gmi,
        "samples_per_transition": drawn,
        "physics_impl": config.physics.impl,
        **{key: getattr(algo, key) for key in _SHOWN},
    }


def measured(given: argparse.Namespace, config: Any, backend: Any) -> dict[str, Any]:
    """One repeat: rates of both ways, and how the second compares."""
    overrides, per_iteration = tuple(given.overrides), config.algo.unroll_length
    one = gmijax.plan(gmis_per_gpu=1)
    two = gmijax.plan(gmis_per_gpu=2, backend=backend)
    with tempfile.TemporaryDirectory() as folder:
        [alone] = gmijax.launch(
            one, Alternating(), overrides, given.window_s, run_dir=f"{folder}/one"
        )
        agent, learner = gmijax.launch(
            two, Separate(), overrides, given.window_s, run_dir=f"{folder}/two"
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
    file = results_file(given, "off-policy", f"-{config.env.slug}")
    file.results["resolved"] = resolved(config, config.algo)
    for _, backend in in_turn(given.backends, given.repeats):
        file.add("repeats", measured(given, config, backend))
    for backend, gains in summary(file.results["repeats"]).items():
        shown = ", ".join(f"{name} {gain:.2f}x" for name, gain in gains.items())
        sys.stdout.write(f"{backend}: {shown} of one program, medians of {given.repeats}\n")
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
