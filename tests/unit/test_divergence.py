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
from gmijax.learning.report_thread import ReportThread
from gmijax.learning.training_log import TrainingLog
from gmijax.learning.unroll import Counts, no_counts
from gmijax.physics_health import TOLERATED_STEPS
from gmijax.ppo.loop import report
from gmijax.sim.wrappers import env_keys

ENV = point_mass()
INIT, STEP = jax.jit(ENV.init), jax.jit(ENV.step)
N = 4


def _step_from(x: list[float]):
    state = INIT(ENV.model, env_keys(jax.random.key(0), 0, N))
    position, velocity = jnp.asarray(x), state.env.physics[1]
    state = state._replace(
        env=state.env._replace(physics=(position, velocity), obs=jnp.ones((N, 2)))
    )
    return STEP(ENV.model, state, jnp.zeros((N, 1)))


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


def _counts(**diverged: int) -> Counts:
    counts = no_counts(ENV.spec)
    bad = {name: jnp.asarray(float(steps)) for name, steps in diverged.items()}
    return counts._replace(diverged=counts.diverged | bad)


def test_few_bad_steps_are_tolerated_and_many_are_named() -> None:
    log = TrainingLog("point_mass", (), 0)
    for count in (TOLERATED_STEPS, TOLERATED_STEPS + 1):
        metrics = metrics_from(_counts(any=count, **{"reward/near": count}))
        if count <= TOLERATED_STEPS:
            report(log, 64, metrics, {})
        else:
            with pytest.raises(
                NonFiniteError, match=r"point_mass, up to env step 128: .* reward/near"
            ):
                report(log, 128, metrics, {})


def test_a_loss_that_is_not_finite_is_named() -> None:
    metrics = metrics_from(_counts())
    spoilt = metrics._replace(losses=metrics.losses._replace(value_loss=jnp.asarray(jnp.nan)))
    with pytest.raises(NonFiniteError, match="value_loss of the update is not finite"):
        report(TrainingLog("point_mass", (), 0), 64, spoilt, {})


def test_reports_come_in_order_from_a_thread_of_their_own_and_errors_with_the_next_call() -> None:
    written: list[int] = []

    def write(number: int) -> None:
        if number < 0:
            raise NonFiniteError("bad number")
        written.append(number)

    thread = ReportThread(write)
    for number in (1, 2, 3):
        thread.report(number)
    thread.wait()
    assert written == [1, 2, 3]
    thread.report(-1)
    with pytest.raises(NonFiniteError, match="bad number"):
        thread.report(4)
    thread.stop()
    assert written == [1, 2, 3]


def test_a_report_that_cannot_come_is_not_waited_for() -> None:
    is_there = threading.Event()
    thread = ReportThread(lambda: is_there.wait(30))
    thread.report()
    thread.give_up()
    started = time.monotonic()
    thread.stop()
    assert time.monotonic() - started < 1.5  # It waits 2 s for one that may come.
    is_there.set()
