"""`algo.recompute_advantages`: values and advantages anew before every pass over a rollout."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from axis_collectives import run_together
from toy_env import point_mass

from gmijax.cli.compose import compose
from gmijax.collectives.program import LocalCollectives
from gmijax.errors import ConfigError
from gmijax.learning.learner import acting_weights, init_learner, make_learner
from gmijax.learning.normalize import moments_of
from gmijax.learning.updates import minibatch_order, run_updates
from gmijax.ppo.ppo import flat, gradients, learn, update_context
from gmijax.ppo.rollout import rollout, valued_anew
from gmijax.sim.wrappers import env_keys

N, T = 16, 12
ENV = point_mass(episode_length=5)


def learner_of(passes: int, minibatches: int = 1) -> Any:
    """With one minibatch the order of samples is of no account."""
    config = dataclasses.replace(
        compose("algo.recompute_advantages=true").algo,
        unroll_length=T,
        num_minibatches=minibatches,
        num_updates_per_batch=passes,
        learning_rate=1e-2,
        learning_rate_schedule="adaptive_kl",
        policy_hidden_layer_sizes=(8,),
        value_hidden_layer_sizes=(8,),
    )
    return make_learner(ENV.spec, config)


@pytest.fixture(scope="module")
def state() -> Any:
    learner = learner_of(1)
    return jax.jit(lambda key: init_learner(learner, ENV.spec.obs_size, key))(jax.random.key(0))


@pytest.fixture(scope="module")
def rolled(state) -> Any:
    """Samples, trajectory and statistics of two halves of the environments, and of all."""
    program = jax.jit(partial(rollout, ENV, learner_of(1)))

    def of(first: int, num_envs: int) -> Any:
        envs = jax.jit(ENV.init)(ENV.model, env_keys(jax.random.key(1), first, num_envs))
        return program(ENV.model, acting_weights(learner_of(1), state), envs)[1:]

    return of(0, N), of(N, N), of(0, 2 * N)


def learnt(learner: Any, state: Any, rolled: Any, *, recompute: bool = True) -> Any:
    samples, trajectory, stats = rolled
    steps = trajectory if recompute else None
    return jax.jit(lambda: learn(learner, LocalCollectives(), state, samples, stats, steps)[0])()


def test_by_the_policy_that_acted_nothing_is_new(state, rolled) -> None:
    samples, trajectory, _ = rolled[2]
    assert bool(trajectory.truncated.any())
    weights = acting_weights(learner_of(1), state)
    again = valued_anew(learner_of(1), weights, samples, trajectory)
    np.testing.assert_allclose(again.value, samples.value, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(again.advantage, samples.advantage, rtol=1e-4, atol=1e-5)
    assert again.obs is samples.obs


def close(one: Any, other: Any) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4), one, other)


def test_in_one_pass_nothing_is_new(state, rolled) -> None:
    learner = learner_of(1, minibatches=4)
    new, old = (learnt(learner, state, rolled[2], recompute=on) for on in (True, False))
    close(new.params, old.params)
    assert new.learning_rate == old.learning_rate


def test_what_the_values_have_learnt_counts_in_the_second_pass(state, rolled) -> None:
    """Against two passes by hand."""
    learner, (samples, trajectory, stats) = learner_of(2, minibatches=4), rolled[2]
    order = minibatch_order(learner.config, state, jnp.int32(0), samples.advantage.size)
    by_hand = state
    for part in jnp.split(order, 2):
        renewed = valued_anew(learner, acting_weights(learner, by_hand), samples, trajectory)
        anew = stats._replace(advantage=moments_of(renewed.advantage, 2))
        context = update_context(learner, state, anew)
        by_hand, _, _ = jax.jit(
            lambda now, data, context, part: run_updates(
                learner, LocalCollectives(), gradients, now, data, context, part, None
            )
        )(by_hand, flat(renewed), context, part)
    found = learnt(learner, state, rolled[2])
    close(found.params, by_hand.params)
    np.testing.assert_allclose(found.learning_rate, by_hand.learning_rate, rtol=1e-6)
    once = learnt(learner, state, rolled[2], recompute=False)
    with pytest.raises(AssertionError):
        close(found.params, once.params)


def test_two_trainers_learn_what_one_does(state, rolled) -> None:
    """Also how advantages are normalised in every pass is the same."""
    learner = learner_of(4)

    def step(collectives: Any, _: Any, state: Any, own: Any) -> Any:
        samples, trajectory, stats = own
        state, metrics = learn(learner, collectives, state, samples, stats, trajectory)
        return state, None, metrics

    halves = jax.tree.map(lambda *x: jnp.stack(x), *rolled[:2])
    states, _, _ = run_together(step, (), state, halves)
    for leaf in jax.tree.leaves(states.params):
        np.testing.assert_array_equal(leaf[0], leaf[1])
    alone = learnt(learner, state, rolled[2])
    close(jax.tree.map(lambda leaf: leaf[0], states.params), alone.params)


def test_trainers_apart_from_their_simulators_cannot() -> None:
    with pytest.raises(ConfigError, match=r"recompute_advantages=true: .* must be false"):
        compose("algo.recompute_advantages=true", "plan.template=tdg_ex")
