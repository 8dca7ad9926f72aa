"""What a learner beside its agents gains: `python -m benchmarks.off_policy env=ant num_envs=4096`.

SAC on one GPU in two ways: agents and learner in turn in one program, as `algo=sac` trains, and in
two GMIs at the same time. The two GMIs exchange neither experience nor weights: this is what the
GPU allows before anything is moved. Each acts or learns as fast as it can (`free`), or waits for
the other so that the ratio of updates to steps is that of one program (`held`). The learner draws
from a full replay. Adds a call to `benchmarks/results/off-policy-<task>-<device>.json`: rounds
(steps of all environments) and updates of the critics per second, and how busy the GPU was.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

import gmijax
from benchmarks.records import results_file
from benchmarks.runner import exit_code, in_turn, options
from gmijax.config import SacConfig, TrainConfig
from gmijax.errors import ConfigError
from gmijax.machine.nvidia import load_of

LEAD = 2
"""Iterations that one of two GMIs may be ahead of the other where the ratio is held."""

_SAMPLE_S = 0.1
_SHOWN = (
    *("batch_size", "updates_per_step", "policy_every", "unroll_length", "replay_steps"),
    *("precision", "replay_precision", "critic_hidden_layer_sizes", "policy_hidden_layer_sizes"),
)


class Window(NamedTuple):
    """A measurement: iterations per second, and the part of the time in which the GPU was busy.

    NVML says the latter, of all processes together; None where it does not.
    """

    rate: float
    utilisation: float | None = None


class Alternating(gmijax.Role):
    """One GMI: both in turn in one program, then each alone."""

    def run(self, overrides: tuple[str, ...], window_s: float) -> dict[str, Window]:
        """How fast each is."""
        from benchmarks.off_policy_programs import Programs

        programs = Programs(overrides)
        steps = {"both": programs.both, "act": programs.act, "learn": programs.learn}
        return {name: free_window(self, step, window_s) for name, step in steps.items()}


class Separate(gmijax.Role):
    """One of two GMIs: the first acts, the second learns."""

    def run(self, overrides: tuple[str, ...], window_s: float) -> dict[str, Window]:
        """How fast this one is, free and with the ratio held."""
        from benchmarks.off_policy_programs import Programs

        programs = Programs(overrides)
        step = programs.act if self.rank == 0 else programs.learn
        free = free_window(self, step, window_s)
        rates = self.collective(np.eye(2)[self.rank] * free.rate, "sum")
        count = max(LEAD + 1, int(window_s * min(rates)))  # The same on both: none waits in vain.
        with sampled_utilisation(self.rank) as samples:
            held = held_rate(self, step, count)
        return {"free": free, "held": Window(held, mean_of(samples))}


@contextmanager
def sampled_utilisation(rank: int) -> Iterator[list[float]]:
    """Samples of the use of the first GMI's GPU while it is entered; none on the others."""
    device, samples, is_over = os.environ.get("CUDA_VISIBLE_DEVICES"), [], threading.Event()

    def sample() -> None:
        while device and not is_over.wait(_SAMPLE_S) and (load := load_of(device)) is not None:
            samples.append(load.busy)

    thread = threading.Thread(target=sample, daemon=True)
    if rank == 0:
        thread.start()
    try:
        yield samples
    finally:
        is_over.set()
        if rank == 0:
            thread.join()


def mean_of(samples: Sequence[float]) -> float | None:
    """The mean, None of no samples."""
    return statistics.fmean(samples) if samples else None


def free_window(role: gmijax.Role, step: Callable[[], None], window_s: float) -> Window:
    """A measurement that all GMIs begin together."""
    for _ in range(3):
        step()
    role.collective(0.0)
    with sampled_utilisation(role.rank) as samples:
        started_s, count = time.monotonic(), 0
        while time.monotonic() - started_s < window_s:
            step()
            count += 1
            role.progress(count)
        rate = count / (time.monotonic() - started_s)
    return Window(rate, mean_of(samples))


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
    held = min(agent["held"].rate, learner["held"].rate)
    return {
        "backend": backend,
        "in_turn": {
            "rounds_per_s": per_iteration * alone["both"].rate,
            "updates_per_s": updates * alone["both"].rate,
            "acting_alone_rounds_per_s": per_iteration * alone["act"].rate,
            "learning_alone_updates_per_s": updates * alone["learn"].rate,
            "utilisation": {name: window.utilisation for name, window in alone.items()},
        },
        "two_gmis": {
            "free_rounds_per_s": per_iteration * agent["free"].rate,
            "free_updates_per_s": updates * learner["free"].rate,
            "held_rounds_per_s": per_iteration * held,
            "held_updates_per_s": updates * held,
            "utilisation": {name: window.utilisation for name, window in agent.items()},
        },
        "gain": {
            "rounds_free": agent["free"].rate / alone["both"].rate,
            "updates_free": learner["free"].rate / alone["both"].rate,
            "held": held / alone["both"].rate,
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
