"""Buffers of the simulator that are too small are counted, logged and told once."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import pytest
from toy_env import metrics_from, point_mass_env

from gmijax.learning.training_log import TrainingLog
from gmijax.learning.unroll import no_counts
from gmijax.metrics import Line
from gmijax.ppo.loop import report
from gmijax.ppo.ppo import IterationMetrics
from gmijax.sim.interface import OVERFLOWS
from gmijax.sim.wrappers import env_keys, training_env

N = 4


class Lines:
    """A sink that keeps what it is told."""

    def __init__(self) -> None:
        self.lines: list[dict[str, Any]] = []

    def write(self, line: Line) -> None:
        self.lines.append(dict(line))

    def close(self) -> None:
        return None


def metrics(env: Any, overflowed: dict[str, int]) -> IterationMetrics:
    steps = {name: jnp.asarray(count) for name, count in overflowed.items()}
    return metrics_from(no_counts(env.spec, env.overflows)._replace(overflowed=steps))


def test_worlds_that_met_a_full_buffer_are_counted_by_buffer() -> None:
    task = point_mass_env()

    def overflow(state: Any) -> jax.Array:
        return jnp.stack([jnp.ones((), bool), state.obs[0] > 0.0])

    env = training_env(task._replace(overflow=overflow))
    state = env.init(env.model, env_keys(jax.random.key(0), 0, N))
    _, out = env.step(env.model, state, jnp.zeros((N, 1)))
    counts = {name: int(count) for name, count in out.overflowed.items()}
    assert counts == {"contact": N, "constraint": int((out.next_obs[:, 0] > 0.0).sum())}
    assert 0 < counts["constraint"] < N


def test_without_such_buffers_there_is_nothing_to_count() -> None:
    env = training_env(point_mass_env())
    state = env.init(env.model, env_keys(jax.random.key(0), 0, N))
    assert env.step(env.model, state, jnp.zeros((N, 1)))[1].overflowed == {}
    sink = Lines()
    report(TrainingLog("point_mass", (sink,), 0), 64, metrics(env, {}), {})
    assert not [name for name in sink.lines[0] if name.startswith("physics/")]


def test_the_first_overflow_is_told_and_all_are_logged(
    capsys: pytest.CaptureFixture[str],
) -> None:
    env = training_env(
        point_mass_env()._replace(overflow=lambda _: jnp.zeros(len(OVERFLOWS), bool))
    )
    sink = Lines()
    log = TrainingLog("point_mass", (sink,), 0)
    for iteration, count in enumerate((0, 5, 7), start=1):
        found = metrics(env, {"contact": count, "constraint": 0})
        report(log, 64 * iteration, found, {})
    assert [line["physics/contact_overflow_steps"] for line in sink.lines] == [0.0, 5.0, 7.0]
    assert [line["physics/constraint_overflow_steps"] for line in sink.lines] == [0.0] * 3
    assert log.overflows.steps == {"contact": 12.0, "constraint": 0.0}
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert told[0].startswith("point_mass: MJX-Warp's contact buffer was too small in 5 ")
