import dataclasses
import functools
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_device_memory import FAKES
from toy_env import point_mass

from gmijax.cli.compose import compose
from gmijax.collectives.communicator import SingleRankCommunicator
from gmijax.collectives.device_transport import DeviceTransport
from gmijax.collectives.host.shared_block import LANES, create_exchange
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.collectives.host_transport import HostTransport
from gmijax.collectives.program import LocalCollectives, StagedAllReduce
from gmijax.collectives.strategies import stages
from gmijax.learning.learner import (
    acting_weights,
    adapted_learning_rate,
    apply_gradients,
    finish_iteration,
    init_learner,
    make_learner,
    state_values,
    with_targets,
)
from gmijax.learning.loop import warm_up
from gmijax.learning.normalize import Moments, moments_of, no_samples, normalize, std_of
from gmijax.learning.updates import exchange_size, minibatch_order, run_updates
from gmijax.partition.layout import Layout
from gmijax.ppo.loss import PpoLosses
from gmijax.ppo.ppo import flat, gradients, iterate, update_context
from gmijax.ppo.rollout import rollout
from gmijax.ppo.statistics import merge_stats
from gmijax.sim.wrappers import env_keys

N, T = 32, 8
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


def _compiled(iteration, learner):
    iteration.trace(ENV.model, *_start(learner))
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


@pytest.mark.parametrize("schedule", ["fixed", "adaptive_kl"])
def test_learning_rates_share_a_program(config, schedule: str) -> None:
    programs = set()
    for rate in (1e-3, 2e-3):
        changed = dataclasses.replace(
            config, learning_rate=rate, learning_rate_schedule=schedule, num_updates_per_batch=1
        )
        learner = make_learner(ENV.spec, changed)
        step = functools.partial(iterate, ENV, learner, LocalCollectives())
        programs.add(jax.jit(step).lower(ENV.model, *_start(learner)).as_text())
    assert len(programs) == 1


@pytest.mark.parametrize(
    ("rate", "kl", "adapted"),
    [
        (3e-4, 0.1, 2e-4),
        (3e-4, 0.001, 4.5e-4),
        (3e-4, 0.01, 3e-4),
        (3e-4, 0, 3e-4),
        (1e-5, 1, 1e-5),
    ],
)
def test_the_learning_rate_follows_the_divergence(rate: float, kl: float, adapted: float) -> None:
    found = adapted_learning_rate(jnp.float32(rate), jnp.float32(kl), 0.01)
    assert float(found) == pytest.approx(adapted)


class _Kl(NamedTuple):
    steering_kl: jax.Array


def test_the_schedule_acts_on_every_minibatch(config) -> None:
    """Four minibatches, whose divergences are given."""
    mine = make_learner(
        ENV.spec,
        dataclasses.replace(
            config,
            learning_rate_schedule="adaptive_kl",
            desired_kl=0.01,
        ),
    )
    state, _ = _start(mine)
    kls = jnp.array([0.1, 0.004, 0.01, 0.1])

    def gradients_of(learner, params, data, context, indices):
        return jax.tree.map(jnp.zeros_like, params), _Kl(data[indices[0]])

    order = jnp.arange(4)[:, None]
    _, _, rates = jax.jit(
        lambda state: run_updates(
            mine, LocalCollectives(), gradients_of, state, kls, None, order, None
        )
    )(state)
    np.testing.assert_allclose(rates, [1e-3 / 1.5, 1e-3, 1e-3, 1e-3 / 1.5], rtol=1e-5)


@pytest.fixture(scope="module")
def size(config) -> int:
    return exchange_size(ENV.spec, config, PpoLosses)


@pytest.fixture(scope="module")
def alone(learner):
    """The iteration of a job with one GMI, compiled."""
    return _compiled(
        SingleRankCommunicator().program(functools.partial(iterate, ENV, learner)), learner
    )


@contextmanager
def _all_reduce(strategy: str, num_floats: int) -> Iterator[StagedAllReduce]:
    """Exchanges of a job with one rank, which is this process, as one of several would have."""
    fd, layout = create_exchange(), Layout.even(1, 1)
    control, host = (
        SharedMemoryGroup(fd, 0, 1, num_floats, timeout_s=5.0, rendezvous_timeout_s=5.0, lane=lane)
        for lane in range(LANES)
    )
    os.close(fd)
    parts = stages(strategy, layout)
    transport = HostTransport(host, num_floats)
    if strategy == "one_shot":
        transport = DeviceTransport(control, host, layout, num_floats, parts, FAKES["fake"])
    all_reduce = StagedAllReduce(transport, parts, 0, 1)
    transport.start([all_reduce.is_right])
    yield all_reduce
    all_reduce.close()
    host.close()
    control.close()


@pytest.mark.parametrize("strategy", ["mpr", "one_shot", "mpr, by pass"])
def test_exchanges_in_the_program_change_nothing_but_its_place(
    strategy: str, config, learner, size, alone
) -> None:
    if strategy == "mpr, by pass":
        strategy = "mpr"
        learner = make_learner(ENV.spec, dataclasses.replace(config, recompute_advantages=True))
        alone = _compiled(
            SingleRankCommunicator().program(functools.partial(iterate, ENV, learner)), learner
        )
    with _all_reduce(strategy, size) as all_reduce:
        step = all_reduce.program(functools.partial(iterate, ENV, learner))
        results = []
        reported_s = 0.0
        for iteration in (alone, _compiled(step, learner)):
            state, envs = _start(learner)
            for _ in range(3):
                state, envs, metrics = iteration(state, envs)
                # Each reports what is finished by then, which may be two iterations or none.
                reported_s += step.exchange_s or 0.0
            iteration.wait()
            results.append((state.params, state.obs_moments, envs.env.obs, metrics))
        assert reported_s > 0
    _close(*results, atol=1e-4)


def test_shards_of_minibatches_give_the_update_of_the_whole(learner) -> None:
    """Two GMIs with N environments against one process with 2 N, on the same samples."""
    state, _ = _start(learner)
    roll_out = jax.jit(functools.partial(rollout, ENV, learner))
    gradients_of = jax.jit(functools.partial(gradients, learner))
    apply = jax.jit(functools.partial(apply_gradients, learner))

    def collected(num_envs: int, first: int):
        envs = _start(learner, num_envs, first)[1]
        _, samples, _, stats = roll_out(ENV.model, acting_weights(learner, state), envs)
        return flat(samples), stats

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


def _learnt(step, state, envs):
    """State, environments and last metrics after iterations in which the return has risen."""
    returns = []
    for _ in range(60):
        state, envs, metrics = step(state, envs)
        returns.append(float(metrics.counts.reward_sum) / (T * N))
    assert np.mean(returns[-10:]) > np.mean(returns[:10]) + 0.4
    return state, envs, metrics


def test_it_learns_to_stand_still(learner, alone) -> None:
    state, _, _ = _learnt(alone, *_start(learner))
    assert int(state.iteration) == 60
    assert float(state.obs_moments.count) == 60 * T * N


def test_it_learns_with_other_settings_and_updates_the_policy_that_acted(config) -> None:
    """In bfloat16, with a tanh, and with values of any scale."""
    mine = make_learner(
        ENV.spec,
        dataclasses.replace(
            config,
            precision="bfloat16",
            reward_scaling=100.0,
            normalize_values=True,
            obs_outliers="diverged",
            obs_std_floor=1e-2,
            distribution_type="tanh_normal",
            state_dependent_std=True,
        ),
    )
    step = _compiled(SingleRankCommunicator().program(functools.partial(iterate, ENV, mine)), mine)
    state, envs, metrics = _learnt(step, *warm_up(step, *_start(mine)))
    assert state.value_moments is not None
    assert float(state.obs_moments.count) == float(state.value_moments.count) == 61 * T * N
    assert float(std_of(state.value_moments)) > 10.0
    assert float(metrics.figures["value/explained_variance"]) > 0.3
    learnt = jax.tree.leaves((state.params, state.opt_state[1].mu))
    assert {leaf.dtype for leaf in learnt} == {jnp.dtype("float32")}
    # Learning computes what acting did, though its batches are others: nothing has moved yet,
    # also where the unit of the values moves with what was seen.
    roll_out = jax.jit(functools.partial(rollout, ENV, mine))
    samples, _, stats = roll_out(ENV.model, acting_weights(mine, state), envs)[1:]
    assert samples.obs.dtype == jnp.bfloat16
    context = update_context(mine, state, merge_stats(jax.tree.map(lambda x: x[None], stats)))
    first = jax.jit(functools.partial(gradients, mine))
    more = Moments(jnp.float32(4000.0), jnp.float32(50.0), jnp.float32(4000.0 * 5000.0**2))
    moved = with_targets(mine, state, more)
    assert float(std_of(moved.value_moments)) > 1.5 * float(std_of(state.value_moments))
    for now in (state, moved):
        now_in = context._replace(value_moments=now.value_moments)
        _, losses = first(now.params, flat(samples), now_in, jnp.arange(5, 69))
        assert abs(float(losses.kl)) < 1e-6
        assert float(losses.clip_fraction) == float(losses.value_clip_fraction) == 0.0


def test_a_warm_up_fills_the_statistics_and_nothing_else(learner, alone) -> None:
    state, envs = warm_up(alone, *_start(learner))
    first, _ = _start(learner)
    assert float(state.obs_moments.count) == T * N
    assert float(jnp.max(state.obs_moments.m2)) > 0.0
    for name in ("params", "opt_state", "learning_rate", "iteration"):
        jax.tree.map(np.testing.assert_array_equal, getattr(state, name), getattr(first, name))
    state, envs, _ = alone(state, envs)  # It goes on from there.
    assert float(state.obs_moments.count) == 2 * T * N


def test_no_learning_rate_is_lost_and_no_number_is_written_twice(config, alone) -> None:
    """GPUs would copy it within host memory, for which the host waits (`IterationMetrics`)."""
    _check_no_number_is_written_twice(alone)
    adaptive = dataclasses.replace(
        config, num_updates_per_batch=1, learning_rate_schedule="adaptive_kl", desired_kl=1e-7
    )
    mine = make_learner(ENV.spec, adaptive)
    step = SingleRankCommunicator().program(functools.partial(iterate, ENV, mine))
    # The first update has not moved yet, the others each lower the rate.
    rates = [1e-3 / 1.5**k for k in range(4)]
    _, _, report = _compiled(step, mine)(*_start(mine))
    assert float(report.figures["policy/learning_rate"]) == pytest.approx(rates[-1])
    assert {k: float(v) for k, v in report.rates.items()} == pytest.approx(
        {"mean": np.mean(rates), "min": rates[-1], "max": rates[0]}
    )
    _check_no_number_is_written_twice(step)


def _check_no_number_is_written_twice(iteration) -> None:
    program = iteration._program
    count = len(jax.tree.leaves(program.out_info[2]))
    lines = program.as_text().splitlines()
    made_by = {found[1]: line for line in lines if (found := re.search(r"(%\S+) =", line))}
    returned = [line for line in lines if "ROOT" in line][-1].partition("tuple(")[2]
    results = re.findall(r"%[\w.\-]+", returned)[-count:]
    while any(copied := [name for name in results if " copy(" in made_by[name]]):
        source = {name: re.findall(r"%[\w.\-]+", made_by[name])[1] for name in copied}
        results = [source.get(name, name) for name in results]
    assert len(set(results)) == count


@pytest.mark.parametrize("hidden", [(16, 16), ()])
@pytest.mark.parametrize(("mean", "std"), [(5.0, 3.0), (-2e3, 900.0), (0.0, 1e-3)])
def test_values_stay_when_their_unit_moves(config, hidden, mean: float, std: float) -> None:
    changes = {"normalize_values": True, "value_hidden_layer_sizes": hidden}
    mine = make_learner(ENV.spec, dataclasses.replace(config, **changes))
    state, _ = _start(mine)
    obs = jax.random.normal(jax.random.key(1), (50, ENV.spec.obs_size))

    def values(state):
        return state_values(mine.networks, acting_weights(mine, state), obs)

    def targets(key: int, mean: float, std: float) -> Moments:
        return moments_of(mean + std * jax.random.normal(jax.random.key(key), (400,)), 1)

    # The first unit is one for a network that has learnt nothing.
    first = with_targets(mine, state, targets(2, 0.4, 2.0))
    jax.tree.map(np.testing.assert_array_equal, first.params, state.params)
    later = with_targets(mine, first, targets(3, mean, std))
    assert abs(float(std_of(later.value_moments) / std_of(first.value_moments)) - 1.0) > 0.2
    tolerance = 1e-6 * max(1.0, abs(mean))
    np.testing.assert_allclose(values(later), values(first), rtol=1e-5, atol=tolerance)
    jax.tree.map(np.testing.assert_array_equal, later.params.policy, state.params.policy)


def test_without_the_key_there_is_no_unit_to_move(learner) -> None:
    state, _ = _start(learner)
    assert with_targets(learner, state, no_samples(())) is state


@pytest.mark.parametrize("preserved", [True, False])
def test_outputs_may_stay_what_they_were_when_the_statistics_change(
    config, preserved: bool
) -> None:
    spec = ENV.spec._replace(obs_size=3, actor_obs_size=2)
    mine = make_learner(spec, dataclasses.replace(config, preserve_outputs=preserved))
    state = init_learner(mine, 3, jax.random.key(0))
    samples = jax.random.normal(jax.random.key(1), (2, 64, 3))

    def outputs(state, obs):
        weights = acting_weights(mine, state)
        seen = normalize(weights.moments, obs)
        return mine.networks.output(weights.params, seen), state_values(
            mine.networks, weights, seen
        )

    # A first iteration gives observations their unit: nothing is to be kept.
    before = finish_iteration(mine, state, moments_of(samples[0], 1))
    jax.tree.map(np.testing.assert_array_equal, before.params, state.params)
    after = finish_iteration(mine, before, moments_of(1.0 + 1.5 * samples[1], 1))
    assert int(after.iteration) == 2
    assert float(after.obs_moments.count) == 128
    old, new = outputs(before, samples[0]), outputs(after, samples[0])
    if preserved:
        _close(old, new, atol=1e-5)
    else:
        for one, other in zip(old, new, strict=True):
            assert float(jnp.max(jnp.abs(one - other))) > 1e-3


def test_weights_of_an_input_that_hardly_moves_stay_as_they_are(config) -> None:
    mine = make_learner(
        ENV.spec, dataclasses.replace(config, preserve_outputs=True, obs_std_floor=1e-3)
    )
    stds = jnp.full(ENV.spec.obs_size, 2e-2).at[0].set(5e-3)
    samples = stds * jax.random.normal(jax.random.key(1), (2, 64, ENV.spec.obs_size))
    state = init_learner(mine, ENV.spec.obs_size, jax.random.key(0))
    before = finish_iteration(mine, state, moments_of(samples[0], 1))
    after = finish_iteration(mine, before, moments_of(1.5 * samples[1], 1))
    old, new = (one.params.policy["params"]["Dense_0"]["kernel"] for one in (before, after))
    np.testing.assert_array_equal((old == new).all(1), jnp.arange(ENV.spec.obs_size) == 0)
