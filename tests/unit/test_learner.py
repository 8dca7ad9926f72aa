import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_device_memory import one_shot_of_one
from jax.sharding import Mesh
from toy_env import point_mass

from gmijax.cli import compose
from gmijax.collectives.solo import SoloReducer
from gmijax.collectives.spmd import AXIS, SpmdStep
from gmijax.learner import (
    adapted_learning_rate,
    apply_gradients,
    init_learner,
    make_learner,
)
from gmijax.ppo.learner import gradients, minibatch_order, update_context
from gmijax.ppo.programs import FusedIteration, SpmdIteration, exchange_size
from gmijax.ppo.rollout import collect, merge_stats
from gmijax.ppo.split import SplitIteration
from gmijax.sim.wrappers import env_keys

N, T = 12, 8
ENV = point_mass()


@pytest.fixture(scope="module")
def config():
    return dataclasses.replace(
        compose().algo,
        unroll_length=T,
        num_minibatches=4,
        num_updates_per_batch=3,
        learning_rate=1e-3,
        learning_rate_schedule="fixed",
        init_noise_std=0.6,
        reward_scaling=1.0,
        policy_hidden_layer_sizes=(16,),
        value_hidden_layer_sizes=(16,),
    )


@pytest.fixture(scope="module")
def learner(config):
    return make_learner(ENV.spec, config)


def _start(learner, num_envs: int = N, first: int = 0):
    state = init_learner(learner, ENV.spec.obs_size, jax.random.key(0))
    keys = env_keys(jax.random.key(1), first, num_envs)
    # In one jit, so that no two leaves share a buffer: iterations donate them.
    return state, jax.jit(ENV.init)(ENV.model, keys)


def _close(a, b, atol=1e-6):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=atol), a, b)


def test_every_sample_is_visited_once_per_epoch(learner) -> None:
    state, _ = _start(learner)
    order = minibatch_order(learner, state, jnp.int32(0), T * N)
    epochs = np.asarray(order).reshape(3, -1)
    for epoch in epochs:
        np.testing.assert_array_equal(np.sort(epoch), np.arange(T * N))
    assert not np.array_equal(epochs[0], epochs[1])


def test_orders_differ_between_ranks_and_iterations(learner) -> None:
    state, _ = _start(learner)
    first = minibatch_order(learner, state, jnp.int32(0), T * N)
    other_rank = minibatch_order(learner, state, jnp.int32(1), T * N)
    later = minibatch_order(learner, state._replace(iteration=jnp.int32(1)), jnp.int32(0), T * N)
    assert not np.array_equal(first, other_rank)
    assert not np.array_equal(first, later)


def test_the_learning_rate_follows_the_divergence() -> None:
    rate = jnp.float32(3e-4)
    assert float(adapted_learning_rate(rate, jnp.float32(0.1), 0.01)) == pytest.approx(2e-4)
    assert float(adapted_learning_rate(rate, jnp.float32(0.001), 0.01)) == pytest.approx(4.5e-4)
    assert float(adapted_learning_rate(rate, jnp.float32(0.01), 0.01)) == pytest.approx(3e-4)
    assert float(adapted_learning_rate(rate, jnp.float32(0.0), 0.01)) == pytest.approx(3e-4)
    slowest = adapted_learning_rate(jnp.float32(1e-5), jnp.float32(1.0), 0.01)
    assert float(slowest) == pytest.approx(1e-5)


class Spmd(SoloReducer):
    """One process that makes a program of all devices, of which there is one."""

    is_device_resident = True

    def spmd(self, step):
        return SpmdStep(Mesh(np.array(jax.devices()[:1]), (AXIS,)), [0], step)


def _spmd(learner, config) -> SpmdIteration:
    iteration = SpmdIteration.if_possible(ENV, learner, Spmd(exchange_size(ENV.spec, config)))
    assert iteration is not None
    return iteration


def test_all_paths_compute_the_same(learner, config) -> None:
    size = exchange_size(ENV.spec, config)
    fused = FusedIteration(ENV, learner)
    split = SplitIteration(ENV, learner, SoloReducer(size))
    results = []
    with one_shot_of_one(size) as reducer:
        queued = SpmdIteration.if_possible(ENV, learner, reducer)
        assert queued is not None
        for iteration in (fused, split, _spmd(learner, config), queued):
            state, envs = _start(learner)
            iteration.trace(state, envs)
            iteration.compile()
            for _ in range(3):
                state, envs, metrics = iteration(state, envs)
            iteration.wait()
            results.append((state.params, state.obs_moments, envs.env.obs, metrics))
        assert queued.times["time/reduce_s"] > 0
    for result in results[1:]:
        _close(results[0], result, atol=1e-4)


def test_one_program_of_all_takes_other_states_than_its_own(learner, config) -> None:
    iteration = _spmd(learner, config)
    iteration.trace(*_start(learner))
    iteration.compile()
    state, envs, _ = iteration(*_start(learner))
    once = jax.device_get(state.params)
    copies = jax.tree.map(jnp.copy, (state, envs))
    continued = iteration(state, envs)
    again = iteration(*_start(learner))
    jax.tree.map(np.testing.assert_array_equal, once, again[0].params)
    # As a resumed run does.
    resumed = iteration(*copies)
    jax.tree.map(np.testing.assert_array_equal, continued[0].params, resumed[0].params)
    np.testing.assert_array_equal(continued[1].env.obs, resumed[1].env.obs)


def test_a_reducer_that_spans_no_program_splits_the_iteration(learner, config) -> None:
    size = exchange_size(ENV.spec, config)
    assert SpmdIteration.if_possible(ENV, learner, SoloReducer(size)) is None


class OnDevice(SoloReducer):
    """Keeps the gradient where it is, as rings do."""

    is_device_resident = True
    exchange_s = 0.25

    def run_on_device(self, program):
        def mean(buffer):
            assert isinstance(buffer, jax.Array)
            return buffer

        return program(mean)

    def mean(self, buffer):
        raise AssertionError("through the host")


def test_gradients_can_stay_on_the_device(learner, config) -> None:
    size = exchange_size(ENV.spec, config)
    results = []
    for reducer in (SoloReducer(size), OnDevice(size)):
        iteration = SplitIteration(ENV, learner, reducer)
        state, envs = _start(learner)
        iteration.trace(state, envs)
        iteration.compile()
        for _ in range(2):
            state, envs, metrics = iteration(state, envs)
        results.append((state.params, envs.env.obs, metrics))
        assert iteration.times["time/update_s"] > 0
        assert (iteration.times["time/reduce_s"] == 0.25) == isinstance(reducer, OnDevice)
    jax.tree.map(np.testing.assert_array_equal, *results)


def test_shards_of_minibatches_give_the_update_of_the_whole(learner) -> None:
    """Two GMIs with N environments against one process with 2 N, on the same samples."""
    state, _ = _start(learner)
    collected = [
        collect(
            ENV, learner.networks, learner.config, ENV.model, state.params, state.obs_moments, envs
        )
        for envs in (_start(learner, first=0)[1], _start(learner, first=N)[1])
    ]
    whole_envs = _start(learner, num_envs=2 * N)[1]
    _, whole, whole_stats = collect(
        ENV, learner.networks, learner.config, ENV.model, state.params, state.obs_moments,
        whole_envs,
    )  # fmt: skip
    stats = merge_stats(jax.tree.map(lambda *x: jnp.stack(x), *[c[2] for c in collected]))
    _close(stats.advantage, whole_stats.advantage, atol=1e-4)
    _close(stats.obs, whole_stats.obs, atol=1e-3)
    _close(stats.episodes, whole_stats.episodes)

    context = update_context(learner, state, stats)
    shards = [jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), c[1]) for c in collected]
    whole = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), whole)
    order = [minibatch_order(learner, state, jnp.int32(rank), T * N) for rank in range(2)]
    sharded = single = state
    for k in range(order[0].shape[0]):
        parts = [
            gradients(learner, sharded.params, shards[r], context, order[r][k]) for r in range(2)
        ]
        grads, losses = jax.tree.map(lambda *x: sum(x) / 2, *parts)
        sharded = apply_gradients(learner, sharded, grads, losses.kl)
        # Sample (t, env) of shard r is row t * 2N + r * N + env of the whole.
        rows = [(o[k] // N) * 2 * N + r * N + o[k] % N for r, o in enumerate(order)]
        grads, losses = gradients(learner, single.params, whole, context, jnp.concatenate(rows))
        single = apply_gradients(learner, single, grads, losses.kl)
    _close(sharded.params, single.params, atol=2e-5)
    np.testing.assert_allclose(sharded.learning_rate, single.learning_rate)


def test_it_compiles_once_and_learns_to_stand_still(learner) -> None:
    iteration = FusedIteration(ENV, learner)
    state, envs = _start(learner, num_envs=64)
    iteration.trace(state, envs)
    iteration.compile()  # A compiled program cannot be traced again.
    returns = []
    for _ in range(80):
        state, envs, metrics = iteration(state, envs)
        returns.append(float(metrics.reward_sum) / (T * 64))
    assert np.mean(returns[-10:]) > np.mean(returns[:10]) + 0.4


@pytest.mark.parametrize("schedule", ["fixed", "adaptive_kl"])
def test_no_number_is_told_twice(config, schedule) -> None:
    """GPUs would copy it within host memory, for which the host waits (`IterationMetrics`)."""
    learner = make_learner(ENV.spec, dataclasses.replace(config, learning_rate_schedule=schedule))
    iteration = FusedIteration(ENV, learner)
    iteration.trace(*_start(learner))
    told = len(jax.tree.leaves(iteration._program.out_info[2]))
    iteration.compile()
    lines = iteration._program.as_text().splitlines()
    made_by = {found[1]: line for line in lines if (found := re.search(r"(%\S+) =", line))}
    results = re.findall(r"%[\w.\-]+", _returned(lines))[-told:]
    while any(copied := [name for name in results if " copy(" in made_by[name]]):
        source = {name: re.findall(r"%[\w.\-]+", made_by[name])[1] for name in copied}
        results = [source.get(name, name) for name in results]
    assert len(set(results)) == told


def test_learning_rates_of_all_updates_are_told(config) -> None:
    adaptive = dataclasses.replace(
        config, num_updates_per_batch=1, learning_rate_schedule="adaptive_kl", desired_kl=1e-7
    )
    mine = make_learner(ENV.spec, adaptive)
    reducer = SoloReducer(exchange_size(ENV.spec, adaptive))
    # The first update has not moved yet, the others each lower the rate.
    rates = [1e-3 / 1.5**k for k in range(4)]
    for iteration in (FusedIteration(ENV, mine), SplitIteration(ENV, mine, reducer)):
        _, _, told = iteration(*_start(mine))
        assert float(told.learning_rate) == pytest.approx(rates[-1])
        assert {k: float(v) for k, v in told.rates.items()} == pytest.approx(
            {"mean": np.mean(rates), "min": rates[-1], "max": rates[0]}
        )


def _returned(lines: list[str]) -> str:
    """What the program returns, in XLA's words."""
    return [line for line in lines if "ROOT" in line][-1].partition("tuple(")[2]


def test_the_normaliser_changes_only_between_iterations(learner) -> None:
    iteration = FusedIteration(ENV, learner)
    state, envs = _start(learner)
    new, _, metrics = iteration(state, envs)
    assert float(new.obs_moments.count) == T * N
    assert int(new.iteration) == 1
    # The first ratio of every iteration is 1, so the first losses see no clipping at all.
    assert float(metrics.losses.clip_fraction) < 1.0
