import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_device_memory import one_shot_of_one
from jax.sharding import Mesh
from toy_env import point_mass

from gmijax.cli.compose import compose
from gmijax.collectives.build import SoloReducer
from gmijax.collectives.spmd import AXIS, SpmdStep
from gmijax.learning.learner import (
    acting_weights,
    adapted_learning_rate,
    apply_gradients,
    init_learner,
    make_learner,
)
from gmijax.learning.updates import exchange_size, minibatch_order
from gmijax.ppo.iteration import SplitIteration, StepOfOne, make_iteration, times_of
from gmijax.ppo.ppo import (
    PpoLosses,
    flatten,
    gradients,
    merge_stats,
    rollout,
    update_context,
)
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


def _compiled(iteration, learner, num_envs: int = N):
    iteration.trace(ENV.model, *_start(learner, num_envs))
    iteration.compile()
    return iteration


def test_every_sample_is_visited_once_per_epoch_in_orders_that_differ(learner) -> None:
    state, _ = _start(learner)

    def order(rank: int, iteration: int) -> np.ndarray:
        at = state._replace(iteration=jnp.int32(iteration))
        return np.asarray(minibatch_order(learner.config, at, jnp.int32(rank), T * N))

    first = order(rank=0, iteration=0).reshape(3, -1)
    for epoch in first:
        np.testing.assert_array_equal(np.sort(epoch), np.arange(T * N))
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first, order(rank=1, iteration=0).reshape(3, -1))
    assert not np.array_equal(first, order(rank=0, iteration=1).reshape(3, -1))


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


@pytest.fixture(scope="module")
def size(config) -> int:
    return exchange_size(ENV.spec, config, PpoLosses)


@pytest.fixture(scope="module")
def fused(learner, size):
    """The iteration of a job with one GMI, compiled."""
    return _compiled(make_iteration(ENV, learner, SoloReducer(size)), learner)


@pytest.fixture(scope="module")
def spmd(learner, size):
    return _compiled(make_iteration(ENV, learner, Spmd(size)), learner)


def test_all_paths_compute_the_same(learner, size, fused, spmd) -> None:
    split = _compiled(SplitIteration(ENV, learner, SoloReducer(size)), learner)
    results = []
    with one_shot_of_one(size) as reducer:
        queued = _compiled(make_iteration(ENV, learner, reducer), learner)
        for iteration in (fused, split, spmd, queued):
            state, envs = _start(learner)
            for _ in range(3):
                state, envs, metrics = iteration(state, envs)
            iteration.wait()
            results.append((state.params, state.obs_moments, envs.env.obs, metrics))
        assert times_of(queued)["time/reduce_s"] > 0
    for result in results[1:]:
        _close(results[0], result, atol=1e-4)


def test_one_program_of_all_takes_other_states_than_its_own(learner, spmd) -> None:
    state, envs, _ = spmd(*_start(learner))
    once = jax.device_get(state.params)
    copies = jax.tree.map(jnp.copy, (state, envs))
    continued = spmd(state, envs)
    again = spmd(*_start(learner))
    jax.tree.map(np.testing.assert_array_equal, once, again[0].params)
    # As a resumed run does.
    resumed = spmd(*copies)
    jax.tree.map(np.testing.assert_array_equal, continued[0].params, resumed[0].params)
    np.testing.assert_array_equal(continued[1].env.obs, resumed[1].env.obs)


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


def test_gradients_can_stay_on_the_device(learner, size) -> None:
    results = []
    for reducer in (SoloReducer(size), OnDevice(size)):
        iteration = _compiled(SplitIteration(ENV, learner, reducer), learner)
        state, envs = _start(learner)
        for _ in range(2):
            state, envs, metrics = iteration(state, envs)
        results.append((state.params, envs.env.obs, metrics))
        assert iteration.times["time/update_s"] > 0
        assert (iteration.times["time/reduce_s"] == 0.25) == isinstance(reducer, OnDevice)
    jax.tree.map(np.testing.assert_array_equal, *results)


def test_a_reducer_that_spans_no_program_splits_the_iteration(learner, size) -> None:
    several = SoloReducer(size)
    several.world_size = 2
    assert isinstance(make_iteration(ENV, learner, several), SplitIteration)


def test_shards_of_minibatches_give_the_update_of_the_whole(learner) -> None:
    """Two GMIs with N environments against one process with 2 N, on the same samples."""
    state, _ = _start(learner)
    roll_out = jax.jit(functools.partial(rollout, ENV, learner))
    gradients_of = jax.jit(functools.partial(gradients, learner))
    apply = jax.jit(functools.partial(apply_gradients, learner))

    def collected(num_envs: int, first: int):
        envs = _start(learner, num_envs, first)[1]
        _, samples, stats = roll_out(ENV.model, acting_weights(learner, state), envs)
        return flatten(samples), stats

    shards, shard_stats = zip(collected(N, 0), collected(N, N), strict=True)
    whole, whole_stats = collected(2 * N, 0)
    stats = merge_stats(jax.tree.map(lambda *x: jnp.stack(x), *shard_stats))
    _close(stats.advantage, whole_stats.advantage, atol=1e-4)
    _close(stats.obs, whole_stats.obs, atol=1e-3)
    _close(stats.counts.episodes, whole_stats.counts.episodes)

    context = update_context(learner, state, stats)
    order = [minibatch_order(learner.config, state, jnp.int32(rank), T * N) for rank in range(2)]
    sharded = single = state
    for k in range(order[0].shape[0]):
        parts = [gradients_of(sharded.params, shards[r], context, order[r][k]) for r in range(2)]
        grads, losses = jax.tree.map(lambda *x: sum(x) / 2, *parts)
        sharded = apply(sharded, grads, losses.kl)
        # Sample (t, env) of shard r is row t * 2N + r * N + env of the whole.
        rows = [(o[k] // N) * 2 * N + r * N + o[k] % N for r, o in enumerate(order)]
        grads, losses = gradients_of(single.params, whole, context, jnp.concatenate(rows))
        single = apply(single, grads, losses.kl)
    _close(sharded.params, single.params, atol=2e-5)
    np.testing.assert_allclose(sharded.learning_rate, single.learning_rate)


def test_it_compiles_once_and_learns_to_stand_still(learner, size) -> None:
    # A compiled program cannot be traced again.
    iteration = _compiled(make_iteration(ENV, learner, SoloReducer(size)), learner, num_envs=64)
    state, envs = _start(learner, num_envs=64)
    returns = []
    for _ in range(80):
        state, envs, metrics = iteration(state, envs)
        returns.append(float(metrics.counts.reward_sum) / (T * 64))
    assert np.mean(returns[-10:]) > np.mean(returns[:10]) + 0.4


def test_the_normaliser_changes_only_between_iterations(learner, fused) -> None:
    new, _, metrics = fused(*_start(learner))
    assert float(new.obs_moments.count) == T * N
    assert int(new.iteration) == 1
    # The first ratio of every iteration is 1, so the first losses see no clipping at all.
    assert float(metrics.losses.clip_fraction) < 1.0


def test_no_learning_rate_is_lost_and_no_number_is_written_twice(config, size, fused) -> None:
    """GPUs would copy it within host memory, for which the host waits (`IterationMetrics`)."""
    _check_no_number_is_written_twice(fused)
    adaptive = dataclasses.replace(
        config, num_updates_per_batch=1, learning_rate_schedule="adaptive_kl", desired_kl=1e-7
    )
    mine, alone = make_learner(ENV.spec, adaptive), SoloReducer(size)
    # The first update has not moved yet, the others each lower the rate.
    rates = [1e-3 / 1.5**k for k in range(4)]
    for iteration in (make_iteration(ENV, mine, alone), SplitIteration(ENV, mine, alone)):
        _, _, told = _compiled(iteration, mine)(*_start(mine))
        assert float(told.learning_rate) == pytest.approx(rates[-1])
        assert {k: float(v) for k, v in told.rates.items()} == pytest.approx(
            {"mean": np.mean(rates), "min": rates[-1], "max": rates[0]}
        )
        if isinstance(iteration, StepOfOne):
            _check_no_number_is_written_twice(iteration)


def _check_no_number_is_written_twice(iteration: StepOfOne) -> None:
    program = iteration._program
    count = len(jax.tree.leaves(program.out_info[2]))
    lines = program.as_text().splitlines()
    made_by = {found[1]: line for line in lines if (found := re.search(r"(%\S+) =", line))}
    results = re.findall(r"%[\w.\-]+", _returned(lines))[-count:]
    while any(copied := [name for name in results if " copy(" in made_by[name]]):
        source = {name: re.findall(r"%[\w.\-]+", made_by[name])[1] for name in copied}
        results = [source.get(name, name) for name in results]
    assert len(set(results)) == count


def _returned(lines: list[str]) -> str:
    """What the program returns, in XLA's words."""
    return [line for line in lines if "ROOT" in line][-1].partition("tuple(")[2]
