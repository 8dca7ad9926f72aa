"""Worlds with bad numbers are ended, counted, and do no harm."""

from __future__ import annotations

import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import metrics_from, point_mass

from gmijax.errors import NonFiniteError
from gmijax.metrics import Line, MetricsLog
from gmijax.physics_health import TOLERATED_STEPS
from gmijax.ppo.programs import IterationMetrics
from gmijax.ppo.report import Reporter, ReportThread
from gmijax.ppo.rollout import stats_example
from gmijax.sim.wrappers import env_keys

ENV = point_mass()
N = 4


def _step_from(x: list[float]):
    state = jax.jit(ENV.init)(ENV.model, env_keys(jax.random.key(0), 0, N))
    position, velocity = jnp.asarray(x), state.env.physics[1]
    state = state._replace(
        env=state.env._replace(physics=(position, velocity), obs=jnp.ones((N, 2)))
    )
    return jax.jit(ENV.step)(ENV.model, state, jnp.zeros((N, 1)))


def test_a_bad_world_ends_with_its_last_good_observation_and_no_reward() -> None:
    _, out = _step_from([0.0, float("nan"), 1e12, 0.5])
    np.testing.assert_array_equal(out.terminated, [False, True, True, False])
    np.testing.assert_array_equal(out.next_obs[1:3], 1.0)
    np.testing.assert_array_equal(out.reward[1:3], 0.0)
    assert np.isfinite(out.reward).all()


def test_bad_worlds_are_counted_by_where_the_number_was() -> None:
    _, out = _step_from([0.0, float("nan"), 1e7, 0.5])
    # 1e7 is a possible position, but no observation; its square is finite too.
    counts = {name: int(count) for name, count in out.diverged.items()}
    assert counts == {
        "any": 2,
        "physics": 1,
        "observation": 2,
        "reward/near": 1,
        "reward/effort": 0,
    }


def test_a_bad_world_starts_over_and_the_others_go_on() -> None:
    state, _ = _step_from([0.0, float("nan"), 0.0, 0.5])
    np.testing.assert_array_equal(state.env.steps, [1, 0, 1, 1])
    assert np.isfinite(state.env.obs).all()


@pytest.mark.parametrize("count", [TOLERATED_STEPS, TOLERATED_STEPS + 1])
def test_few_bad_steps_are_tolerated_and_many_are_named(count: int) -> None:
    stats = stats_example(ENV.spec)
    stats = stats._replace(
        diverged=stats.diverged | {"any": jnp.asarray(count), "reward/near": jnp.asarray(count)}
    )
    metrics = metrics_from(stats)
    reporter = Reporter("point_mass", MetricsLog(()), 0)
    if count <= TOLERATED_STEPS:
        reporter.report(64, metrics, {})
    else:
        with pytest.raises(NonFiniteError, match=r"point_mass, up to env step 64: .* reward/near"):
            reporter.report(64, metrics, {})


def _metrics(bad_steps: int) -> IterationMetrics:
    stats = stats_example(ENV.spec)
    stats = stats._replace(diverged=stats.diverged | {"any": jnp.asarray(bad_steps)})
    return metrics_from(stats)


def test_lines_come_in_order_from_a_thread_of_their_own_and_errors_with_the_next_call() -> None:
    written: list[Line] = []

    class Sink:
        def write(self, line: Line) -> None:
            written.append(line)

        def close(self) -> None:
            pass

    lines = ReportThread(Reporter("point_mass", MetricsLog((Sink(),)), 0))
    for iteration in (1, 2, 3):
        lines.report(64 * iteration, _metrics(0), {})
    lines.wait()
    assert [line["env_steps"] for line in written] == [64, 128, 192]
    lines.report(256, _metrics(TOLERATED_STEPS + 1), {})
    with pytest.raises(NonFiniteError, match="up to env step 256"):
        lines.report(320, _metrics(0), {})
    lines.stop()
    assert len(written) == 3


def test_a_line_that_cannot_come_is_not_waited_for() -> None:
    is_there = threading.Event()

    class Pending:
        def __array__(self, dtype=None, copy=None):
            is_there.wait(30)
            return np.zeros(())

    lines = ReportThread(Reporter("point_mass", MetricsLog(()), 0))
    lines.report(64, _metrics(0)._replace(noise_std=Pending()), {})
    lines.give_up()
    started = time.monotonic()
    lines.stop()
    assert time.monotonic() - started < 1.5  # It waits 2 s for one that may come.
    is_there.set()
