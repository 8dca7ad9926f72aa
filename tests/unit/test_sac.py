"""SAC: what is drawn from the replay, the targets, what learns when, and whether it learns."""

from __future__ import annotations

from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import point_mass

import gmijax
from gmijax.collectives.program import LocalCollectives
from gmijax.errors import ConfigError
from gmijax.learning.start import begin_episodes
from gmijax.sac.critics import critics_of, projected
from gmijax.sac.losses import Batch, critic_loss, target_probs, temperature_loss
from gmijax.sac.replay import CUT, GOES_ON, TERMINATED, empty_replay, insert, kind_of, sample
from gmijax.sac.sac import SAC
from gmijax.sac.updates import target_entropy
from gmijax.sim.interface import EnvSpec

ENV = point_mass()
TINY = (
    *("env=ball_balance", "algo=sac", "num_envs=16", "algo.batch_size=64"),
    *("algo.critic_hidden_layer_sizes=[32,32]", "algo.policy_hidden_layer_sizes=[32,32]"),
    *("algo.replay_steps=64", "algo.updates_per_step=2", "algo.reward_scaling=0.5"),
    "algo.unroll_length=1",
)


def rows(first: int, num: int, lengths: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Observations (episode, step) [T, N, 2] and kinds [T, N] of endless episodes of N lengths.

    Every other episode of an environment ends by its task, the others by time.
    """
    obs = np.zeros((num, len(lengths), 2), np.float32)
    kind = np.zeros((num, len(lengths)), np.int8)
    for env, length in enumerate(lengths):
        for row in range(num):
            episode, step = divmod(first + row, length)
            obs[row, env] = episode, step
            if step == length - 1:
                kind[row, env] = TERMINATED if episode % 2 else CUT
    return obs, kind


@pytest.mark.parametrize("num_inserted", [6, 12, 15, 42])
def test_no_transition_joins_two_episodes(num_inserted: int) -> None:
    lengths, ring = [3, 5, 7], 12
    replay = empty_replay(EnvSpec("x", 2, 1, 0.0, 0, ()), ring, len(lengths))
    for first in range(0, num_inserted, 3):
        obs, kind = rows(first, 3, lengths)
        zeros = jnp.zeros(kind.shape)
        replay = jax.jit(insert)(replay, obs, zeros[..., None], zeros, kind)
    assert int(replay.filled) == min(num_inserted, ring)
    drawn = jax.device_get(jax.jit(sample, static_argnums=2)(replay, jax.random.key(0), 4096))
    goes_on = drawn.kind == GOES_ON
    np.testing.assert_array_equal(drawn.next_obs[goes_on], drawn.obs[goes_on] + [0, 1])
    # All that is there is drawn, but for the newest row; and nothing else.
    expected, kinds = rows(max(0, num_inserted - ring), min(num_inserted, ring) - 1, lengths)
    pairs = [{(*obs, kind) for obs, kind in zip(*them, strict=True)} for them in (
        (drawn.obs.tolist(), drawn.kind.tolist()),
        (expected.reshape(-1, 2).tolist(), kinds.reshape(-1).tolist()),
    )]  # fmt: skip
    assert pairs[0] == pairs[1]


def test_what_follows_a_step() -> None:
    yes, no = jnp.array(True), jnp.array(False)
    assert int(kind_of(no, no, no)) == GOES_ON
    assert int(kind_of(yes, no, no)) == int(kind_of(yes, yes, no)) == TERMINATED
    assert int(kind_of(no, yes, no)) == int(kind_of(yes, no, yes)) == CUT


def test_a_projection_keeps_mass_and_mean() -> None:
    atoms = jnp.linspace(-2.0, 2.0, 5)
    values = jnp.array([[-2.0, -0.25, 0.0, 1.5, 2.0], [-9.0, -9.0, 9.0, 9.0, 9.0], [1.0] * 5])
    probs = jnp.array([[0.1, 0.2, 0.3, 0.2, 0.2], [0.5, 0.0, 0.5, 0.0, 0.0], [0.2] * 5])
    found = np.asarray(projected(atoms, values, probs))
    np.testing.assert_allclose(found.sum(-1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(found[0] @ atoms, probs[0] @ values[0], rtol=1e-6)
    np.testing.assert_allclose(found[1], [0.5, 0, 0, 0, 0.5])  # Beyond the ends.
    np.testing.assert_allclose(found[2], [0, 0, 0, 1, 0])  # An atom is hit.


def learner_of(*overrides: str) -> Any:
    config = gmijax.compose(*TINY, *overrides).algo
    return SAC.make_learner(ENV.spec, config)


def batch_of(kind: int) -> Batch:
    ones = jnp.ones((2, 1))
    return Batch(jnp.ones((2, 2)), ones, 3.0 * ones[:, 0], jnp.full(2, kind, jnp.int8), ones)


def test_targets_look_one_step_on_unless_the_task_has_ended() -> None:
    class Sure:
        """Critics that expect a return of 2 for sure."""

        atoms = jnp.linspace(-10.0, 10.0, 21)

        def log_probs(self, params: Any, obs: Any, action: Any) -> jax.Array:
            return jnp.log(jnp.tile(jnp.eye(21)[12], (2, 2, 1)) + 1e-12)

    critics: Any = Sure()
    config = learner_of("algo.discounting=0.5").config
    for kind, wanted in ((GOES_ON, 3.0 + 0.5 * (2.0 - 0.1 * -4.0)), (TERMINATED, 3.0)):
        probs = target_probs(
            critics,
            None,
            config,
            batch_of(kind),
            jnp.ones((2, 1)),
            jnp.full(2, -4.0),
            0.1,
        )
        np.testing.assert_allclose(probs @ critics.atoms, wanted, rtol=1e-5)


def test_what_is_cut_is_not_learnt_from() -> None:
    critics = critics_of(learner_of().config)
    params = critics.init(jax.random.key(0), 2, 1)
    wanted = jnp.full((2, 2, len(critics.atoms)), 1.0 / len(critics.atoms))
    mixed = batch_of(GOES_ON)._replace(kind=jnp.array([GOES_ON, CUT], jnp.int8))
    mixed = mixed._replace(obs=jnp.array([[1.0, 1.0], [5.0, -5.0]]))
    alone = jax.tree.map(lambda leaf: leaf[:1], mixed)
    loss, _ = critic_loss(params, critics, mixed, wanted)
    np.testing.assert_allclose(loss, critic_loss(params, critics, alone, wanted[:, :1])[0])
    assert float(critic_loss(params, critics, batch_of(CUT), wanted)[0]) == 0.0


def test_the_temperature_falls_where_there_is_too_much_noise() -> None:
    learner = learner_of("algo.target_std=0.15")
    target = target_entropy(learner)
    assert target == pytest.approx(1.4189 + np.log(0.15), abs=1e-3)
    for entropy, sign in ((target + 1.0, 1), (target - 1.0, -1)):
        grad = jax.grad(temperature_loss)(jnp.log(0.1), jnp.full(3, -entropy), target)
        assert np.sign(grad) == sign


def run_of(learner: Any, iterations: int) -> Any:
    state = jax.jit(partial(SAC.init, learner, 2))(jax.random.key(0))
    envs = begin_episodes(ENV, jax.random.key(1), 0, 16, kept_steps=64)
    memory = SAC.begin(learner, ENV, envs)
    iterate: Any = jax.jit(partial(SAC.iterate, ENV, learner, LocalCollectives(), ENV.model))
    for _ in range(iterations):
        before = state
        state, memory, metrics = iterate(state, memory)
        yield before, state, metrics


def test_each_part_learns_when_it_is_its_turn() -> None:
    learner = learner_of(
        *("algo.policy_every=2", "algo.updates_per_step=1", "algo.learning_starts=4"),
        "algo.target_rate=1.0",
    )
    for number, (before, after, _) in enumerate(run_of(learner, 8), start=1):
        learns = number >= 4
        assert int(after.updates) == max(0, number - 3)
        for name, has_turn in (("critics", learns), ("params", learns and number % 2 == 0)):
            old, new = (jax.tree.leaves(getattr(state, name)) for state in (before, after))
            assert any((a != b).any() for a, b in zip(old, new, strict=True)) == has_turn
        # With this rate targets are what the critics have become.
        if learns:
            chex.assert_trees_all_close(after.targets, after.critics, rtol=1e-6, atol=1e-7)
        assert float(after.obs_moments.count) == 16 * number  # Each observation counts once.


def test_it_learns_and_says_where_the_range_of_returns_is_too_small() -> None:
    *_, (_, _, last) = run_of(learner_of("algo.learning_rate=1e-3"), 300)
    assert float(last.counts.reward_sum) / 16 > 0.5  # At first it is about -0.4.
    assert float(last.losses.end_atoms) < 0.05
    *_, (_, _, small) = run_of(learner_of("algo.value_range=1.0"), 20)
    assert float(small.losses.end_atoms) > 0.2


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("algo.replay_steps=63 algo.unroll_length=2", "algo.replay_steps=63: .* a multiple of"),
        ("algo.learning_starts=65", "algo.learning_starts=65: .* at most algo.replay_steps=64"),
        ("algo.batch_size=200", "algo.batch_size=200: .* at most num_envs x .* = 160"),
        ("algo.target_std=0.6", "algo.target_std=0.6: .* at most 0.479"),
        ("algo.distribution_type=normal", "algo.distribution_type=normal: .* tanh_normal"),
        ("algo.preserve_outputs=true", "algo.preserve_outputs=True: .* false"),
        ("algo.updates_per_step=0", "algo.updates_per_step=0"),
        ("plan.template=tdg_ex", "plan.template=tdg_ex: not for gmijax.train with algo=sac"),
    ],
)
def test_what_does_not_fit_is_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        gmijax.compose(*TINY, *override.split())
