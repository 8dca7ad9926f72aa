"""Learning keeps what a policy drew; environments and data sets get the action that it becomes."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import point_mass

from gmijax.a3c.a3c import gradients
from gmijax.a3c.rollout import collect
from gmijax.a3c.targets import Unrolls, batch_targets
from gmijax.cli.compose import compose
from gmijax.collection.programs import policy_of
from gmijax.learning.learner import Learner, TrainState, acting_weights, init_learner, make_learner
from gmijax.learning.normalize import normalize
from gmijax.learning.unroll import act
from gmijax.ppo.rollout import rollout
from gmijax.sim.wrappers import BatchState, env_keys

N, T = 32, 4
ENV = point_mass()


@pytest.fixture(scope="module")
def start() -> tuple[Any, TrainState, BatchState]:
    """A tanh policy with noise so wide that most of its actions are near 1 or -1."""
    config = dataclasses.replace(
        compose("algo=a3c").algo,
        unroll_length=T,
        num_minibatches=2,
        distribution_type="tanh_normal",
        init_noise_std=6.0,
        policy_hidden_layer_sizes=(4,),
        value_hidden_layer_sizes=(4,),
    )
    learner: Learner = make_learner(ENV.spec, config)
    state = jax.jit(lambda key: init_learner(learner, ENV.spec.obs_size, key))(jax.random.key(0))
    return learner, state, jax.jit(ENV.init)(ENV.model, env_keys(jax.random.key(1), 0, N))


def test_an_environment_gets_the_action_of_what_was_drawn(start) -> None:
    learner, state, envs = start
    _, drawn, action = act(learner.networks, acting_weights(learner, state), envs)
    assert float(jnp.max(jnp.abs(drawn.raw))) > 9.0
    np.testing.assert_array_equal(action, jnp.tanh(drawn.raw))


def test_samples_of_ppo_hold_what_was_drawn(start) -> None:
    learner, state, envs = start
    config = dataclasses.replace(
        compose().algo,
        unroll_length=T,
        distribution_type="tanh_normal",
        policy_hidden_layer_sizes=(4,),
        value_hidden_layer_sizes=(4,),
    )
    mine = make_learner(ENV.spec, config)
    program = jax.jit(partial(rollout, ENV, mine))
    samples = program(ENV.model, acting_weights(learner, state), envs)[1]
    assert float(jnp.max(jnp.abs(samples.action))) > 9.0


@pytest.fixture(scope="module")
def batch(start) -> Unrolls:
    learner, state, envs = start
    program = jax.jit(partial(collect, ENV, learner.networks, T))
    return program(ENV.model, acting_weights(learner, state), envs)[1]


def test_agents_send_what_was_drawn(start, batch: Unrolls) -> None:
    learner, state, _ = start
    assert float(jnp.max(jnp.abs(batch.action))) > 9.0
    # Targets find the policy that acted: no ratio of probabilities differs from 1.
    targets = jax.jit(partial(batch_targets, learner))(state, batch, jnp.ones(N))
    np.testing.assert_allclose(targets.log_prob, batch.log_prob, rtol=1e-4, atol=1e-4)
    assert abs(float(targets.behaviour_kl)) < 1e-4


def test_a_ratio_that_overflows_does_not_end_an_asynchronous_run(start, batch: Unrolls) -> None:
    learner, state, _ = start
    odd = batch._replace(log_prob=batch.log_prob.at[0, 0].add(-100.0))

    @jax.jit
    def learnt(state: TrainState) -> Any:
        targets = batch_targets(learner, state, odd, jnp.ones(N))
        # Also during the passes over it.
        targets = targets._replace(log_prob=targets.log_prob.at[1, 1].add(-100.0))
        return targets, gradients(learner, state.params, odd, targets, jnp.arange(N))

    for leaf in jax.tree.leaves(learnt(state)):
        assert np.isfinite(leaf).all()


def test_a_data_set_has_actions_and_their_densities(start) -> None:
    learner, state, envs = start
    weights = acting_weights(learner, state)
    keys = env_keys(jax.random.key(2), 0, N)
    choose = policy_of(learner, deterministic=False)
    action, density = choose(tuple(weights[:2]), envs.env.obs, keys)
    assert float(jnp.max(jnp.abs(action))) <= 1.0
    # By the change of variables, where a float32 still differs from the limit.
    inner = np.abs(np.asarray(action)[:, 0]) < 0.99
    assert inner.any()
    output = learner.networks.output(state.params, normalize(weights.moments, envs.env.obs))
    mean, std = np.asarray(output)[:, 0], 6.0
    raw = np.arctanh(np.asarray(action, np.float64)[:, 0])
    gauss = -0.5 * ((raw - mean) / std) ** 2 - np.log(std * np.sqrt(2 * np.pi))
    wanted = gauss - np.log(1 - np.asarray(action, np.float64)[:, 0] ** 2)
    np.testing.assert_allclose(np.asarray(density)[inner], wanted[inner], rtol=1e-3, atol=1e-3)
