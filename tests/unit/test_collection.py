"""Collecting experience in one process, on a task without physics."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import point_mass

import gmijax
from gmijax.baselines.tdg_steps import infer, next_keys, simulate
from gmijax.collection.programs import (
    ActingPolicy,
    CollectedStep,
    RecordSpec,
    policy_of,
    random_policy,
    unroll,
)
from gmijax.collection.recording import CollectionStats, ShardWriter
from gmijax.errors import NonFiniteError
from gmijax.learning.learner import Learner, init_learner, make_learner
from gmijax.learning.normalize import no_samples
from gmijax.learning.physics_health import TOLERATED_STEPS
from gmijax.learning.unroll import Counts, no_counts
from gmijax.runs.dataset import DataPaths
from gmijax.runs.folder import RunPaths
from gmijax.sim.wrappers import BatchedEnv, env_keys
from gmijax.supervise.child import ChildLink

N, T = 6, 30
ALL = RecordSpec(steps=True, next_obs=True)


class Unrolled(NamedTuple):
    """An unroll of a sampling policy, computed once for all tests."""

    env: BatchedEnv
    learner: Learner
    policy: ActingPolicy
    steps: CollectedStep
    counts: Counts


@pytest.fixture(scope="module")
def unrolled() -> Unrolled:
    algo = gmijax.compose("algo.policy_hidden_layer_sizes=[4]").algo
    env = point_mass(episode_length=8)
    learner, size = make_learner(env.spec, algo), env.spec.obs_size
    state = jax.jit(lambda key: init_learner(learner, size, key))(jax.random.key(3))
    choose = policy_of(learner, deterministic=False)
    policy = ActingPolicy(choose, (state.params, no_samples((size,))), "x")
    program = jax.jit(partial(unroll, env, policy, T, ALL))
    _, steps, counts = program(env.model, policy.weights, start(env))
    assert steps is not None
    return Unrolled(env, learner, policy, steps, counts)


def start(env):
    return jax.jit(env.init)(env.model, env_keys(jax.random.key(0), 0, N))


def test_an_unroll_keeps_what_happened(unrolled: Unrolled):
    _, learner, policy, steps, counts = unrolled
    assert steps.next_obs is not None
    ended = np.asarray(steps.terminated | steps.truncated)
    assert ended.any()
    assert counts.episodes.count == ended.sum()
    assert steps.obs.shape == steps.next_obs.shape == (T, N, 2)
    # Within an episode one step's end is the next one's beginning; after its end it is not.
    same = (np.asarray(steps.next_obs)[:-1] == np.asarray(steps.obs)[1:]).all(-1)
    np.testing.assert_array_equal(same, ~ended[:-1])
    params = policy.weights[0]
    mean = learner.networks.action_mean(params, steps.obs)
    std = np.exp(np.asarray(params.log_std))
    z = (np.asarray(steps.action) - np.asarray(mean)) / std
    density = np.exp(-0.5 * z**2) / (std * math.sqrt(2 * math.pi))
    np.testing.assert_allclose(steps.log_prob, np.log(density.prod(-1)), rtol=1e-4, atol=1e-5)


def test_halves_of_steps_make_the_same_experience_as_an_unroll(unrolled: Unrolled):
    env, _, policy, whole, counts = unrolled
    state, bits = next_keys(start(env))
    total, kept = no_counts(env.spec, env.overflows), []
    half_a, half_s = jax.jit(partial(infer, policy)), jax.jit(partial(simulate, env, ALL))
    for _ in range(T):
        action, density = half_a(policy.weights, state.env.obs, bits)
        state, bits, total, step = half_s(env.model, state, total, action, density)
        kept.append(step)
    halves = jax.tree.map(lambda *leaves: jnp.stack(leaves), *kept)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), whole, halves)
    assert total.episodes.count == counts.episodes.count


def test_random_actions_fill_their_range_with_even_density():
    env = point_mass()
    policy = random_policy(env.spec._replace(action_size=3))
    keys = env_keys(jax.random.key(1), 0, 2000)
    action, density = policy.choose((), jnp.zeros((2000, 2)), keys)
    assert np.abs(action).max() <= 1.0
    assert abs(float(action.mean())) < 0.05
    assert float(action.min()) < -0.99
    np.testing.assert_allclose(density, math.log(1 / 2**3), rtol=1e-6)


def test_a_deterministic_policy_acts_with_its_mean(unrolled: Unrolled):
    choose = policy_of(unrolled.learner, deterministic=True)
    obs, weights = jnp.ones((N, 2)), unrolled.policy.weights
    first, density = choose(weights, obs, env_keys(jax.random.key(1), 0, N))
    second, _ = choose(weights, obs, env_keys(jax.random.key(2), 0, N))
    np.testing.assert_array_equal(first, second)
    assert not np.asarray(density).any()


def test_shards_are_whole_and_say_what_they_are(tmp_path: Path):
    paths = DataPaths(tmp_path)
    paths.folder(1).mkdir()
    for name in (".000002.npz.12-34", ".000002.json.12-34"):
        (paths.folder(1) / name).write_bytes(b"left by a job that was killed")
    writer = ShardWriter(paths, 1, 2, {"seed": 5})
    full = partial(np.full, (T, N), dtype=np.float32)
    step = CollectedStep(full(0), full(1), full(2), full(3), full(4), full(5), None)
    writer.write(step)
    writer.write(step._replace(reward=full(7)))
    writer.wait()
    writer.close()
    assert writer.num_written == 2
    assert paths.shard(1, 2).is_finished()
    assert sorted(path.name for path in paths.folder(1).iterdir()) == [
        *("000002.json", "000002.npz", "000003.json", "000003.npz"),
    ]
    with np.load(paths.shard(1, 3).arrays) as arrays:
        assert set(arrays) == set(CollectedStep._fields) - {"next_obs"}
        assert (arrays["reward"] == 7).all()
    about = [json.loads(paths.shard(1, index).about.read_text()) for index in (2, 3)]
    assert [item["starts_with_reset"] for item in about] == [True, False]
    assert about[0]["seed"] == 5
    assert about[0]["env_steps"] == T * N


def stats_of(folder: Path) -> CollectionStats:
    link = ChildLink(0, RunPaths(folder), None, None)
    link.paths.root.mkdir(parents=True)
    return CollectionStats(link, "point_mass", N * T)


def test_too_many_bad_environments_end_serving_and_the_term_is_named(tmp_path: Path):
    stats, counts = stats_of(tmp_path), no_counts(point_mass().spec)
    few = {"any": jnp.asarray(TOLERATED_STEPS), "reward/near": jnp.asarray(TOLERATED_STEPS)}
    stats.add(counts._replace(diverged=counts.diverged | few))
    assert stats.outcome()["diverged_steps"] == TOLERATED_STEPS
    many = {name: count + 1 for name, count in few.items()}
    message = r"up to env step 360 of this GMI: 11 of 180 steps .*, in reward/near$"
    with pytest.raises(NonFiniteError, match=message):
        stats.add(counts._replace(diverged=counts.diverged | many))
    stats.close()


def test_full_buffers_are_counted_and_the_first_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    stats, counts = stats_of(tmp_path), no_counts(point_mass().spec)
    for count in (0, 5, 7):
        stats.add(counts._replace(overflowed={"contact": jnp.asarray(count)}))
    stats.close()
    assert stats.outcome()["overflow_steps"] == {"contact": 12.0}
    assert len(capsys.readouterr().err.splitlines()) == 1
    lines = RunPaths(tmp_path).gmi(0).metrics.read_text().splitlines()
    key = "physics/contact_overflow_steps"
    assert [json.loads(line)[key] for line in lines] == [0.0, 5.0, 7.0]
