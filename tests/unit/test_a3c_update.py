"""Updates on batches of unrolls, without processes."""

from __future__ import annotations

import dataclasses
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from axis_collectives import run_together
from toy_env import point_mass

from gmijax.a3c.a3c import A3cLosses, gradients, update
from gmijax.a3c.report import histogram_of, mean_and_p99
from gmijax.a3c.rollout import UnrollPrograms, collect
from gmijax.a3c.targets import Unrolls, batch_targets
from gmijax.cli.compose import compose
from gmijax.collectives.program import LocalCollectives
from gmijax.learning.learner import (
    acting_weights,
    init_learner,
    make_learner,
    num_weights,
    pack_weights,
    unpack_weights,
)
from gmijax.sim.wrappers import env_keys

N, T = 12, 8
ENV = point_mass()
COLLECT = jax.jit(partial(collect, ENV), static_argnums=(0, 1))


@pytest.fixture(scope="module")
def config():
    return dataclasses.replace(
        compose("algo=a3c").algo,
        unroll_length=T,
        num_minibatches=2,
        num_updates_per_batch=2,
        learning_rate=1e-3,
        learning_rate_schedule="fixed",
        init_noise_std=0.6,
        policy_hidden_layer_sizes=(16,),
        value_hidden_layer_sizes=(16,),
    )


def _start(config, num_envs: int = N):
    learner = make_learner(ENV.spec, config)
    state = jax.jit(lambda key: init_learner(learner, ENV.spec.obs_size, key))(jax.random.key(0))
    keys = env_keys(jax.random.key(1), 0, num_envs)
    return learner, state, jax.jit(ENV.init)(ENV.model, keys)


def _alone(learner):
    """The compiled update of a job with one trainer: `(state, batch, weight)` -> state, report."""
    program = jax.jit(partial(update, learner, LocalCollectives(), ()))

    def call(state, batch, weight):
        state, _, report = program(state, (batch, weight))
        return state, report

    return call


def _copy(tree):
    return jax.tree.map(jnp.copy, tree)


def _unrolled(learner, state, envs):
    """The environments after an unroll, the unroll, and its counts."""
    return COLLECT(learner.networks, T, ENV.model, acting_weights(learner, state), envs)


@pytest.fixture(scope="module")
def start(config):
    """Learner, its state and environments; nobody may donate them."""
    return _start(config)


@pytest.fixture(scope="module")
def batch(start) -> Unrolls:
    return _unrolled(*start)[1]


@pytest.fixture(scope="module")
def alone(start):
    return _alone(start[0])


def test_weights_travel_as_one_array(config, start) -> None:
    learner, state, _ = start
    weights = acting_weights(learner, state)
    packed = pack_weights(weights)
    assert packed.shape == (num_weights(ENV.spec, config),)
    jax.tree.map(np.testing.assert_array_equal, unpack_weights(weights, packed), weights)


def test_an_unroll_is_what_the_environments_did(config) -> None:
    learner, state, envs = _start(config, num_envs=64)
    before = envs.env.obs
    weights = acting_weights(learner, state)
    cuts = 0
    for _ in range(4):
        envs, got, stats = COLLECT(learner.networks, T, ENV.model, weights, envs)
        np.testing.assert_array_equal(got.state[0], before)
        np.testing.assert_array_equal(got.bootstrap[0], envs.env.obs)
        assert float(stats.episodes.count) == got.done.any(-1).sum()
        # There is a value behind a step where time ran out, and nowhere else.
        np.testing.assert_array_equal(got.cut_value != 0, got.done[..., 1])
        cuts += int(got.done[..., 1].sum())
        before = envs.env.obs
    assert cuts > 0


def test_in_bfloat16_a_trainer_computes_the_policy_that_acted(config) -> None:
    learner, state, envs = _start(dataclasses.replace(config, precision="bfloat16"))
    got = _unrolled(learner, state, envs)[1]
    targets = jax.jit(partial(batch_targets, learner))(state, got, jnp.ones(N))
    np.testing.assert_allclose(targets.log_prob, got.log_prob, atol=1e-5)
    assert float(targets.behaviour_kl) < 1e-6
    assert {x.dtype for x in (*got, targets.output) if x.dtype != bool} == {jnp.dtype("float32")}


def test_pieces_make_the_unroll_that_they_are_parts_of(start) -> None:
    learner, state, envs = start
    weights = acting_weights(learner, state)
    _, whole, counts = _unrolled(*start)
    programs = UnrollPrograms(ENV, learner.networks, T // 4, 4, weights, envs)
    envs, pieces = _copy(envs), []
    for _ in range(4):
        envs, piece = programs.piece(weights, envs)
        pieces.append(piece)
    joined, packed = programs.join(pieces)
    for name, mine in joined._asdict().items():
        np.testing.assert_allclose(mine, getattr(whole, name), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(packed, np.asarray(jax.tree.leaves(counts)), rtol=1e-5)


@pytest.mark.parametrize(
    ("length", "every", "pieces"), [(16, 4, 4), (16, None, 1), (16, 5, 4), (10, 4, 5), (8, 99, 1)]
)
def test_pieces_are_equal_and_not_longer_than_asked_for(config, length, every, pieces) -> None:
    changed = dataclasses.replace(config, unroll_length=length, weights_every=every)
    assert changed.pieces_per_unroll == pieces


def test_unrolls_without_weight_teach_nothing(start, batch, alone) -> None:
    state = start[1]
    weight = jnp.asarray([1.0] * (N - 2) + [0.0] * 2)
    spoilt = batch._replace(reward=batch.reward.at[:, -2:].set(1e6))
    first, _ = alone(state, batch, weight)
    second, _ = alone(state, spoilt, weight)
    jax.tree.map(np.testing.assert_array_equal, first.params, second.params)
    assert int(first.iteration) == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"distribution_type": "tanh_normal"},
        {"state_dependent_std": True},
        {"distribution_type": "tanh_normal", "state_dependent_std": True},
    ],
)
def test_the_entropy_of_stale_unrolls_teaches_nothing(config, changes) -> None:
    learner, state, envs = _start(dataclasses.replace(config, entropy_cost=1.0, **changes))
    batch = _unrolled(learner, state, envs)[1]
    stale = N // 2
    weight = jnp.asarray([2.0] * (N - stale) + [0.0] * stale)
    targets = jax.jit(partial(batch_targets, learner))(state, batch, weight)
    learnt = jax.jit(partial(gradients, learner))
    states = np.array(batch.state)
    states[:, -stale:] += 1.0
    (first, losses), (second, others) = (
        learnt(state.params, one, targets, np.arange(N))
        for one in (batch, batch._replace(state=jnp.asarray(states)))
    )
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert losses.entropy == others.entropy
    # What is fresh counts as it would alone.
    fresh = learnt(state.params, batch, targets, np.arange(N - stale))[1]
    np.testing.assert_allclose(fresh.entropy, 2.0 * float(losses.entropy), rtol=1e-5)


def _together(learner, state, both, weight):
    """The update of two trainers that have half of the batch each."""
    halves = jax.tree.map(lambda x: np.stack(np.split(np.asarray(x), 2, axis=1)), both)
    step = partial(update, learner)
    return run_together(step, (), state, (halves, weight.reshape(2, N)))


def test_two_trainers_stay_equal_and_weigh_fresh_unrolls_alike(config) -> None:
    """However many of them each has."""
    plain = dataclasses.replace(
        config, num_minibatches=1, num_updates_per_batch=1, normalize_advantage=False
    )
    learner, state, envs = _start(plain, num_envs=2 * N)
    both = jax.device_get(_unrolled(learner, state, envs)[1])
    # One trainer has a fresh unroll and stale ones, the other fresh ones only.
    fresh = np.array([1.0] + [0.0] * (N - 1) + [1.0] * N, np.float32)
    weight = fresh * len(fresh) / fresh.sum()
    learn = _alone(learner)
    alone, measured = jax.device_get(learn(state, both, weight))
    states, _, both_measured = jax.device_get(_together(learner, state, both, weight))
    a, b = (jax.tree.map(lambda x, k=k: x[k], states) for k in range(2))
    jax.tree.map(np.testing.assert_array_equal, a.params, b.params)
    jax.tree.map(np.testing.assert_array_equal, a.obs_moments, b.obs_moments)
    seen = both.state.reshape(-1, ENV.spec.obs_size)
    np.testing.assert_allclose(a.obs_moments.mean, seen.mean(0), rtol=1e-4, atol=1e-5)
    assert float(a.obs_moments.count) == len(seen)
    losses = A3cLosses(*(x[0] for x in both_measured.losses))
    np.testing.assert_allclose(measured.losses, losses, rtol=1e-4, atol=1e-6)
    # Adam divides by the gradient's size: its moments show how large it was.
    chex.assert_trees_all_close(alone.opt_state, a.opt_state, rtol=1e-3, atol=1e-6)
    only_fresh = jax.tree.map(lambda x: x[:, fresh > 0], both)
    _, theirs = jax.device_get(learn(state, only_fresh, np.ones(N + 1, np.float32)))
    np.testing.assert_allclose(losses, theirs.losses, rtol=1e-4, atol=1e-6)
    for one in (measured.explained_variance, both_measured.explained_variance[0]):
        np.testing.assert_allclose(one, theirs.explained_variance, rtol=1e-3, atol=1e-4)


def test_a_minibatch_of_stale_unrolls_does_not_dilute_the_divergence(start, batch) -> None:
    learner, state, _ = start
    moved = state.params._replace(log_std=state.params.log_std + 0.1)

    @jax.jit
    def losses_of(fresh):
        targets = batch_targets(learner, state, batch, fresh)
        return gradients(learner, moved, batch, targets, jnp.arange(N))[1]

    shares = (np.ones(N), np.r_[1.0, np.zeros(N - 1)], np.zeros(N))
    losses = [losses_of(np.asarray(fresh, np.float32)) for fresh in shares]
    # Of a trainer with fresh unrolls only, one with a twelfth, and one with none.
    means = A3cLosses(*(sum(parts) / len(parts) for parts in zip(*losses, strict=True)))
    np.testing.assert_allclose(means.steering_kl, losses[0].kl, rtol=1e-4)
    assert float(losses[2].steering_kl) == 0.0


def test_learning_rates_of_all_minibatches_are_reported(config) -> None:
    adaptive = dataclasses.replace(
        config, learning_rate_schedule="adaptive_kl", learning_rate=1e-3, desired_kl=1e-7
    )
    learner, state, envs = _start(adaptive)
    _, batch, _ = _unrolled(learner, state, envs)
    new, measured = _alone(learner)(state, batch, jnp.ones(N))
    # The first pass has not moved yet, the others each lower the rate.
    rates = [1e-3, 1e-3 / 1.5, 1e-3 / 1.5**2, 1e-3 / 1.5**3]
    assert float(measured.rates["max"]) == pytest.approx(rates[0])
    assert float(measured.rates["min"]) == pytest.approx(rates[3])
    assert float(measured.rates["mean"]) == pytest.approx(np.mean(rates))
    assert float(new.learning_rate) == pytest.approx(rates[3])


@pytest.mark.parametrize(
    "changes",
    [{}, {"vtrace": False, "normalize_values": True, "reward_scaling": 100.0}],
    ids=["vtrace", "normalised-values"],
)
def test_it_learns_to_stand_still_from_a_policy_that_lags(config, changes) -> None:
    learner, state, envs = _start(
        dataclasses.replace(config, learning_rate=3e-3, clipping_epsilon=0.2, **changes),
        num_envs=64,
    )
    learn = _alone(learner)
    versions = [acting_weights(learner, _copy(state))] * 3
    rewards = []
    for _ in range(80):
        envs, batch, stats = COLLECT(learner.networks, T, ENV.model, versions[-3], envs)
        state, updated = learn(state, batch, jnp.ones(64))
        versions.append(unpack_weights(versions[0], updated.weights))
        rewards.append(float(stats.reward_sum) / (64 * T))
    assert np.mean(rewards[:5]) < 0.1
    assert np.mean(rewards[-5:]) > 0.4


def test_staleness_by_hand() -> None:
    histogram = histogram_of(np.array([0] * 98 + [3, 500]))
    assert histogram.sum() == 100
    # 500 counts as 127: (3 + 127) / 100; 98 % are at most 0, 99 % at most 3.
    assert mean_and_p99(histogram) == (pytest.approx(1.3), 3.0)
    assert mean_and_p99(0 * histogram) is None
