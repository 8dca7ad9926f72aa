"""SAC: what is drawn from the replay, the targets, what learns when, and whether it learns."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import point_mass

import gmijax
from gmijax.collectives.communicator import SingleRankCommunicator
from gmijax.collectives.program import LocalCollectives
from gmijax.errors import ConfigError
from gmijax.learning.checkpoint import checkpoint_meta, require_disk_for
from gmijax.learning.checkpoint_saver import CheckpointPart, CheckpointSaver
from gmijax.learning.episode_window import Standing
from gmijax.learning.member import Member, Members
from gmijax.learning.normalize import moments_of, no_samples
from gmijax.learning.saved_arrays import on_host
from gmijax.learning.start import begin_episodes
from gmijax.machine.xla_on_cpu import POOL
from gmijax.runs.folder import RunPaths
from gmijax.sac import sac
from gmijax.sac.critics import critics_of, projected
from gmijax.sac.losses import critic_loss, target_probs, temperature_loss
from gmijax.sac.replay import (
    CUT,
    GOES_ON,
    TERMINATED,
    Replay,
    Transitions,
    empty_replay,
    insert,
    kind_of,
    sample,
    sample_obs,
)
from gmijax.sac.sac import SAC, step_into_replay
from gmijax.sac.updates import target_entropy, update_critics, update_policy
from gmijax.sim.interface import EnvSpec

ENV = point_mass()
TINY = (
    *("env=ball_balance", "algo=sac", "num_envs=16", "algo.batch_size=64"),
    *("algo.critic_hidden_layer_sizes=[32,32]", "algo.policy_hidden_layer_sizes=[32,32]"),
    *("algo.replay_steps=64", "algo.updates_per_step=2", "algo.reward_scaling=0.5"),
    *("algo.unroll_length=1", "algo.policy_every=2"),
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


def ring_of(num_inserted: int, lengths: list[int], ring: int) -> Replay:
    """Three rows at a time; the reward is the number of the step in its episode."""
    spec = EnvSpec("x", 2, 1, 0.0, 0, ())
    replay = empty_replay(spec, ring, len(lengths), jnp.float32)
    for first in range(0, num_inserted, 3):
        obs, kind = rows(first, 3, lengths)
        replay = jax.jit(insert)(
            replay, no_samples((2,)), obs, jnp.zeros((*kind.shape, 1)), obs[..., 1], kind
        )
    return replay


draw = jax.jit(sample, static_argnums=(2, 3, 4))


@pytest.mark.parametrize("num_inserted", [6, 12, 15, 42])
def test_no_transition_joins_two_episodes(num_inserted: int) -> None:
    lengths, ring = [3, 5, 7], 12
    replay = ring_of(num_inserted, lengths, ring)
    assert int(replay.filled) == min(num_inserted, ring)
    drawn = jax.device_get(draw(replay, jax.random.key(0), 4096, 1, 0.5))
    goes_on = drawn.is_known & (drawn.discount > 0)
    np.testing.assert_array_equal(drawn.discount[goes_on], 0.5)
    np.testing.assert_array_equal(drawn.next_obs[goes_on], drawn.obs[goes_on] + [0, 1])
    # All that is there is drawn, but for the newest row; and nothing else.
    kind = np.where(drawn.is_known, np.where(drawn.discount > 0, GOES_ON, TERMINATED), CUT)
    expected, kinds = rows(max(0, num_inserted - ring), min(num_inserted, ring) - 1, lengths)
    pairs = [{(*obs, kind) for obs, kind in zip(*them, strict=True)} for them in (
        (drawn.obs.tolist(), kind.tolist()),
        (expected.reshape(-1, 2).tolist(), kinds.reshape(-1).tolist()),
    )]  # fmt: skip
    assert pairs[0] == pairs[1]


@pytest.mark.parametrize("n_step", [2, 3, 8])
@pytest.mark.parametrize("num_inserted", [6, 12, 15, 42])
def test_returns_of_several_steps_stay_in_their_episode(num_inserted: int, n_step: int) -> None:
    lengths = [3, 5, 7]
    drawn = jax.device_get(
        draw(ring_of(num_inserted, lengths, 12), jax.random.key(0), 4096, n_step, 0.5)
    )

    def summed(first: int, steps: int) -> float:
        return sum(0.5**i * (first + i) for i in range(steps))

    known = [leaf[drawn.is_known] for leaf in (drawn.obs, drawn.next_obs, *drawn[2:4])]
    for (episode, step), (next_episode, next_step), reward, discount in zip(*known, strict=True):
        if discount > 0:
            steps = int(next_step - step)
            assert next_episode == episode
            assert 1 <= steps <= n_step
            assert (reward, discount) == (summed(step, steps), 0.5**steps)
        else:
            ends = [length - int(step) for length in lengths]
            assert reward in [summed(step, left) for left in ends if 1 <= left <= n_step]


@pytest.mark.parametrize(
    ("kinds", "reward", "discount", "next_obs"),
    [
        # Three steps go on: what follows the third.
        ("ggggg", 1 + 2 / 2 + 4 / 4, 1 / 8, 3),
        # The task ends in the first, second, third step; then in the fourth, which is not seen.
        ("tgggg", 1, 0, None),
        ("gtggg", 1 + 2 / 2, 0, None),
        ("ggtgg", 1 + 2 / 2 + 4 / 4, 0, None),
        ("gggtg", 1 + 2 / 2 + 4 / 4, 1 / 8, 3),
        # Time runs out, or the simulation diverges: the state before is the last that is known.
        ("cgggg", None, None, None),
        ("gcggg", 1, 1 / 2, 1),
        ("ggcgg", 1 + 2 / 2, 1 / 4, 2),
        ("gggcg", 1 + 2 / 2 + 4 / 4, 1 / 8, 3),
        # Whichever comes first.
        ("gctgg", 1, 1 / 2, 1),
        ("gtcgg", 1 + 2 / 2, 0, None),
        # The newest row: what follows it is not known yet, but the end of the task is.
        ("ggg", 1 + 2 / 2, 1 / 4, 2),
        ("gg", 1, 1 / 2, 1),
        ("gt", 1 + 2 / 2, 0, None),
    ],
)
@pytest.mark.parametrize("wrapped", [0, 3])
def test_a_target_of_three_steps_ends_where_nothing_more_is_known(
    kinds: str, reward: float | None, discount: float | None, next_obs: int | None, wrapped: int
) -> None:
    before = np.full((wrapped, 1), TERMINATED, np.int8)
    own = np.array([["gtc".index(kind)] for kind in kinds], np.int8)
    kind = np.concatenate([before, own])
    number = np.arange(-wrapped, len(kinds), dtype=np.float32)[:, None]
    replay = empty_replay(EnvSpec("x", 1, 1, 0.0, 0, ()), 5, 1, jnp.float32)
    for row in range(len(kind)):
        obs = number[row : row + 1, :, None]
        rewards = 2.0 ** number[row : row + 1]
        replay = insert(replay, no_samples((1,)), obs, obs, rewards, kind[row : row + 1])
    drawn = jax.device_get(draw(replay, jax.random.key(0), 512, 3, 0.5))
    mine = np.flatnonzero(drawn.obs[:, 0] == 0.0)
    assert len(mine) > 20
    assert len(set(drawn.reward[mine])) == 1
    found = jax.tree.map(lambda leaf: leaf[mine[0]], drawn)
    assert bool(found.is_known) == (reward is not None)
    if reward is not None:
        assert (found.reward, found.discount) == (reward, discount)
    if next_obs is not None:
        assert found.next_obs == [next_obs]


def test_half_precision_keeps_small_changes_of_inputs_that_drift() -> None:
    spec, rng = EnvSpec("x", 4, 1, 0.0, 0, ()), np.random.default_rng(0)
    # A height, one that does not move at first, one that drifts far, one beyond float16's range.
    scale, shift = np.array([0.01, 0.0, 0.01, 1e6]), np.array([9.81, 0.5, 0.0, 0.0])

    def made(num: int) -> np.ndarray:
        return (shift + scale * rng.normal(size=(num, 2, 4))).astype(np.float32)

    replay = empty_replay(spec, 8, 2, jnp.float16)
    rows = []
    for _ in range(3):  # 12 rows: the first of them are overwritten.
        obs = made(4)
        zeros = jnp.zeros(obs.shape[:2])
        args = zeros[..., None] + 0.3, zeros, zeros.astype(jnp.int8)
        replay = insert(replay, moments_of(obs, 2), obs, *args)
        rows.append(obs)
        shift[2] += 1000.0
    obs = made(4)
    obs[2, 0, 1] = 2000.0
    replay = insert(replay, moments_of(rows[-1], 2), obs, *args)
    assert float(replay.num_clipped) == 0.0
    found = np.asarray(sample_obs(replay, jax.random.key(0), 256))
    kept = np.concatenate([rows[-1], obs]).reshape(-1, 4)
    for row in found:  # The last rows came with statistics from before a drift.
        error = np.abs(kept - row) / np.array([0.01, 2000.0, 1000.0, 1e6])
        assert error.max(axis=1).min() < 2e-3
        if row[2] < 2500.0:
            assert np.abs(rows[-1].reshape(-1, 4)[:, 2] - row[2]).min() < 1e-3
    drawn = draw(replay, jax.random.key(0), 64, 1, 0.5)
    assert drawn.obs.dtype == drawn.action.dtype == jnp.float32
    np.testing.assert_allclose(drawn.action, 0.3, rtol=1e-3)
    obs[0, 0, 1] = -1e6
    assert float(insert(replay, moments_of(rows[-1], 2), obs, *args).num_clipped) == 1.0


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


def batch_of(discount: float, *, is_known: bool = True) -> Transitions:
    ones = jnp.ones((2, 1))
    known = jnp.full(2, is_known)
    obs, reward = jnp.ones((2, 2)), 3.0 * ones[:, 0]
    return Transitions(obs, ones, reward, jnp.full(2, discount), known, ones)


def test_targets_add_what_follows_unless_the_task_has_ended() -> None:
    class Sure:
        """Critics that expect a return of 2 for sure."""

        atoms = jnp.linspace(-10.0, 10.0, 21)

        def log_probs(self, params: Any, obs: Any, action: Any) -> jax.Array:
            return jnp.log(jnp.tile(jnp.eye(21)[12], (2, 2, 1)) + 1e-12)

    critics: Any = Sure()
    for discount, wanted in ((0.5, 3.0 + 0.5 * (2.0 - 0.1 * -4.0)), (0.0, 3.0)):
        probs = target_probs(
            critics,
            None,
            batch_of(discount),
            jnp.ones((2, 1)),
            jnp.full(2, -4.0),
            0.1,
        )
        np.testing.assert_allclose(probs @ critics.atoms, wanted, rtol=1e-5)


FIRST_STATE = """
import jax, numpy as np
from functools import partial
from gmijax import compose
from gmijax.learning.learner import make_learner
from gmijax.sac.state import init
from gmijax.sim.interface import EnvSpec
learner = make_learner(EnvSpec("x", 24, 3, 0.02, 9, ()), compose("algo=sac").algo)
state = jax.jit(partial(init, learner, 24))(jax.random.key(0))
for leaf in jax.tree.leaves(state.critics):
    if leaf.ndim == 3:
        first, second = np.asarray(leaf)
        assert not np.allclose(first, second)
"""


def test_critics_as_large_as_they_are_used_begin_on_two_cores() -> None:
    cores = sorted(os.sched_getaffinity(0))[:2]
    done = subprocess.run(
        [sys.executable, "-c", FIRST_STATE],
        preexec_fn=partial(os.sched_setaffinity, 0, cores),
        env={k: value for k, value in os.environ.items() if k != POOL},
        timeout=120,
        check=False,
    )
    assert done.returncode == 0


def test_what_is_not_known_is_not_learnt_from() -> None:
    critics = critics_of(learner_of().config)
    params = jax.jit(lambda key: critics.init(key, 2, 1))(jax.random.key(0))
    loss_of = jax.jit(lambda *batch: critic_loss(params, critics, *batch)[0])
    wanted = jnp.full((2, 2, len(critics.atoms)), 1.0 / len(critics.atoms))
    mixed = batch_of(0.5)._replace(is_known=jnp.array([True, False]))
    mixed = mixed._replace(obs=jnp.array([[1.0, 1.0], [5.0, -5.0]]))
    alone = jax.tree.map(lambda leaf: leaf[:1], mixed)
    np.testing.assert_allclose(loss_of(mixed, wanted), loss_of(alone, wanted[:, :1]), rtol=1e-6)
    assert float(loss_of(batch_of(0.5, is_known=False), wanted)) == 0.0


def test_the_temperature_falls_where_there_is_too_much_noise() -> None:
    learner = learner_of("algo.target_std=0.15")
    target = target_entropy(learner)
    assert target == pytest.approx(1.4189 + np.log(0.15), abs=1e-3)
    for entropy, sign in ((target + 1.0, 1), (target - 1.0, -1)):
        grad = jax.grad(temperature_loss)(jnp.log(0.1), jnp.full(3, -entropy), target)
        assert np.sign(grad) == sign


def begun(learner: Any) -> tuple[Any, Any]:
    state = jax.jit(partial(SAC.init, learner, 2))(jax.random.key(0))
    envs = begin_episodes(ENV, jax.random.key(1), 0, 16, kept_steps=64)
    return state, SAC.begin(learner, ENV, envs)


def run_of(learner: Any, iterations: int) -> Any:
    state, memory = begun(learner)
    iterate: Any = jax.jit(partial(SAC.iterate, ENV, learner, LocalCollectives(), ENV.model))
    for _ in range(iterations):
        before = state
        state, memory, metrics = iterate(state, memory)
        yield before, state, metrics


def test_each_part_learns_when_it_is_its_turn() -> None:
    learner = learner_of(
        *("algo.policy_every=2", "algo.updates_per_step=1", "algo.learning_starts=4"),
        *("algo.target_rate=1.0", "algo.unroll_length=2", "algo.batch_size=48"),
    )
    for number, (before, after, metrics) in enumerate(run_of(learner, 4), start=1):
        # Of four rows, a critic learns in the last; the policy after every second.
        assert int(after.updates) == max(0, 2 * number - 3)
        for name in ("critics", "live"):
            old, new = (jax.tree.leaves(getattr(state, name)) for state in (before, after))
            assert any((a != b).any() for a, b in zip(old, new, strict=True)) == (number > 1)
        assert (float(metrics.losses.critic_loss) > 0) == (number > 1)
        # With this rate targets are what the critics have become.
        if number > 1:
            chex.assert_trees_all_close(after.targets, after.critics, rtol=1e-6, atol=1e-7)
        # The policy that is kept has come a little nearer to the one that learns.
        nearer = jax.tree.map(
            lambda old, new: old + 0.005 * (new - old), before.params, after.live
        )
        chex.assert_trees_all_close(after.params, nearer, rtol=1e-5, atol=1e-7)
        assert float(after.obs_moments.count) == 32 * number  # Each observation counts once.


def test_what_is_made_and_learnt_depends_on_the_policy_that_learns_alone() -> None:
    learner = learner_of()
    state, memory = begun(learner)
    step = jax.jit(partial(step_into_replay, ENV, learner, ENV.model))

    @jax.jit
    def made_and_learnt(state: Any) -> Any:
        given = learner, LocalCollectives(), memory.replay, state
        by_critics, by_policy = (
            update(*given, jax.random.key(2))[0] for update in (update_critics, update_policy)
        )
        experience = step(state, memory)[0].replay
        return experience, by_critics.critics, by_critics.log_temperature, by_policy.live

    for _ in range(6):
        memory, _ = step(state, memory)
    other = jax.tree.map(lambda leaf: leaf + 1.0, state.params)
    expected = made_and_learnt(state)
    chex.assert_trees_all_equal(made_and_learnt(state._replace(params=other)), expected)
    for found, one in zip(made_and_learnt(state._replace(live=other)), expected, strict=True):
        with pytest.raises(AssertionError):
            chex.assert_trees_all_close(found, one)


@pytest.mark.parametrize(("updates", "every", "policy"), [(2, 4, 2), (4, 2, 8)])
def test_the_policy_learns_once_after_so_many_updates(
    monkeypatch: pytest.MonkeyPatch, updates: int, every: int, policy: int
) -> None:
    """Counted while it runs: none is made and not used."""
    learner = learner_of(
        *(f"algo.updates_per_step={updates}", f"algo.policy_every={every}"),
        *("algo.unroll_length=4", "algo.learning_starts=4", "algo.batch_size=48"),
    )
    made: list[str] = []

    def counted(name: str) -> Any:
        inner = getattr(sac, name)

        def update(*args: Any) -> Any:
            # No cache takes a program with callbacks, and with real updates it is a large one.
            _, figures = jax.eval_shape(lambda: inner(*args))
            jax.debug.callback(lambda: made.append(name), ordered=False)
            return args[3], jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), figures)

        return update

    for name in ("update_critics", "update_policy"):
        monkeypatch.setattr(sac, name, counted(name))
    *_, (_, state, _) = run_of(learner, 1)
    jax.block_until_ready(state)
    jax.effects_barrier()
    assert (made.count("update_critics"), made.count("update_policy")) == (4 * updates, policy)


def test_several_runs_get_back_the_replays_that_are_theirs(tmp_path: Path) -> None:
    members, replays = [], []
    for number in range(2):
        run = RunPaths(tmp_path / str(number))
        run.root.mkdir()
        config = gmijax.compose(*TINY, "algo.save_replay=true", "physics.impl=jax")
        replay = ring_of(6 + 3 * number, [3, 5], 12)
        saver = CheckpointSaver(0, SingleRankCommunicator(), None)
        envs = {"x": np.zeros(1)}
        meta = checkpoint_meta(config, 32, 1, Standing())
        saver.begin([CheckpointPart(run, meta, None, envs, replay=on_host(replay))])
        saver.finish()
        saver.stop()
        going_on = replace(config.run, resume=str(run.checkpoint(32)))
        members.append(Member(replace(config, run=going_on), run))
        replays.append(replay)
    template = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((2, *leaf.shape), leaf.dtype), replay
    )
    found = Members(members, 0).restored_replay(template, 0, 1)
    expected = jax.tree.map(lambda *rows: np.stack(rows), *map(on_host, replays))
    chex.assert_trees_all_equal(found, expected)
    # Other environments, other experience.
    assert Members(members, 0).restored_replay(template, 0, 2) is None


def test_a_replay_that_the_disk_has_no_room_for_is_refused(tmp_path: Path) -> None:
    run, free = RunPaths(tmp_path), shutil.disk_usage(tmp_path).free
    fits, half = (
        {"x": jax.ShapeDtypeStruct((size,), jnp.float16)} for size in (free // 8, free // 3)
    )
    require_disk_for(run, fits, 2)
    require_disk_for(run, None, 2)
    require_disk_for(run, half, 1)
    with pytest.raises(ConfigError, match=r"^algo.save_replay=true: the replays take .* MiB left"):
        require_disk_for(run, half, 2)


def test_it_learns_and_says_where_the_range_of_returns_is_too_small() -> None:
    *_, (_, _, last) = run_of(learner_of("algo.learning_rate=1e-3"), 300)
    assert float(last.counts.reward_sum) / 16 > 0.5  # At first it is about -0.4.
    assert float(last.losses.end_atoms) < 0.05
    *_, (_, _, small) = run_of(learner_of("algo.value_range=1.0"), 20)
    assert float(small.losses.end_atoms) > 0.2


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "algo.policy_every=3",
            "algo.policy_every=3: .* a divisor of algo.upd.*=2, or",
        ),
        ("algo.policy_every=4", "algo.policy_every=4: .* divides .*unroll_length x .* = 2"),
        ("algo.n_step=0", "algo.n_step=0: must be at least 1"),
        ("algo.n_step=64", "algo.n_step=64: .* less than algo.replay_steps=64"),
        (
            "algo.replay_precision=float16 algo.normalize_observations=false",
            "algo.replay_precision=float16: .* float32 where algo.normalize_observations=false",
        ),
        ("algo.learning_starts=65", "algo.learning_starts=65: .* at most algo.replay_steps=64"),
        ("algo.batch_size=150", "algo.batch_size=150: .* at most num_envs x .* = 144"),
        ("algo.target_std=0.6", "algo.target_std=0.6: .* at most 0.479"),
        ("algo.distribution_type=normal", "algo.distribution_type=normal: .* tanh_normal"),
        ("algo.preserve_outputs=true", "algo.preserve_outputs=True: .* false"),
        ("algo.updates_per_step=0", "algo.updates_per_step=0: must be at least 1"),
        ("algo.recompute_advantages=true", "algo.recompute_advantages"),
        ("algo.clipping_epsilon=0.2", "algo.clipping_epsilon"),
        ("plan.template=tdg_ex", "plan.template=tdg_ex: not for gmijax.train with algo=sac"),
        ("plan.template=decoupled", "plan.template=decoupled: not for .* algo=sac"),
        ("plan.serving_gmis_per_gpu=1", "=1: .*every GMI acts .*plan.serving_gmis_per_gpu=null$"),
        ("plan.training_gpus=[0]", r"=\[0\]: .*every GMI acts .*plan.training_gpus=null$"),
    ],
)
def test_what_does_not_fit_is_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        gmijax.compose(*TINY, *override.split())
