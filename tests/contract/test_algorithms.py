"""What every algorithm must do in jobs all GMIs of which simulate, act and train."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_checkpoint import make_run
from toy_env import point_mass

import gmijax
from gmijax.collectives.communicator import SingleRankCommunicator
from gmijax.collectives.program import LocalCollectives
from gmijax.config import ALGORITHMS, TrainConfig
from gmijax.config.schema import to_dict
from gmijax.deploy.trained import trained_policy
from gmijax.learning.algorithm import Algorithm, iterate_all, load_algorithm
from gmijax.learning.checkpoint import (
    checkpoint_meta,
    finish_checkpoint,
    has_replay,
    restore_envs,
    restore_learner,
    restore_replay,
    save_learner,
)
from gmijax.learning.checkpoint_saver import CheckpointPart, CheckpointSaver
from gmijax.learning.episode_window import Standing
from gmijax.learning.learner import Learner, TrainState, acting_weights
from gmijax.learning.policy_file import save_policy
from gmijax.learning.saved_arrays import on_host
from gmijax.learning.start import begin_episodes
from gmijax.runs.folder import RunPaths, write_json

NUM_ENVS, LENGTH = 8, 4

ROWS: dict[str, tuple[str, ...]] = {
    "ppo": ("algo.num_minibatches=2",),
    "distill": ("algo.num_minibatches=2", "algo.teacher={teacher}"),
    "sac": (
        *("algo.batch_size=16", "algo.critic_hidden_layer_sizes=[16]", "algo.num_atoms=11"),
        *("algo.replay_steps=10", "algo.learning_starts=4", "algo.updates_per_step=1"),
        *("algo.replay_precision=float16", "algo.save_replay=true", "algo.n_step=2"),
    ),
}
"""What each algorithm needs beside its defaults."""

ENV = point_mass()


class Case(NamedTuple):
    """An algorithm with a small configuration."""

    config: TrainConfig
    algorithm: Algorithm
    learner: Learner[Any]

    def first(self, seed: int) -> TrainState:
        make = partial(self.algorithm.init, self.learner, ENV.spec.obs_size)
        return jax.jit(make)(jax.random.key(seed))

    def memory(self, seed: int = 0) -> Any:
        envs = begin_episodes(ENV, jax.random.key(seed), 0, NUM_ENVS, kept_steps=LENGTH)
        return self.algorithm.begin(self.learner, ENV, envs)


@pytest.fixture(scope="module", params=ROWS)
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    teacher = tmp_path_factory.mktemp("teacher")
    make_run(teacher, obs_size=ENV.spec.obs_size, action_size=ENV.spec.action_size)
    config = gmijax.compose(
        *("env=ball_balance", f"algo={request.param}", f"num_envs={NUM_ENVS}"),
        f"algo.unroll_length={LENGTH}",
        "algo.policy_hidden_layer_sizes=[16,8]",
        *(row.format(teacher=teacher) for row in ROWS[request.param]),
    )
    algorithm = load_algorithm(config.algo)
    return Case(config, algorithm, algorithm.make_learner(ENV.spec, config.algo))


def test_every_algorithm_has_a_row() -> None:
    names = {
        get_args(get_type_hints(kind)["name"])[0] for kind in ALGORITHMS if kind.implementation
    }
    assert names == set(ROWS)


def test_iterations_change_weights_and_keep_shapes(case: Case) -> None:
    program = SingleRankCommunicator().program(partial(case.algorithm.iterate, ENV, case.learner))
    state, envs = case.first(0), case.memory()
    # Restored from a checkpoint they have no weak types: that would be another program.
    leaves = jax.tree.leaves((state, envs))
    assert not any(getattr(leaf, "weak_type", False) for leaf in leaves)  # Keys have no such type.
    first = jax.tree.map(jnp.copy, state)
    program.trace(ENV.model, state, envs)
    program.compile()
    for number in range(1, 3):
        state, envs, metrics = program(state, envs)
        program.wait()
        assert int(state.iteration) == number
        assert abs(float(metrics.counts.reward_sum)) > 0
        chex.assert_tree_all_finite(metrics)
    chex.assert_trees_all_equal_shapes_and_dtypes(state, first)
    chex.assert_tree_all_finite(state.params)
    moved = jax.tree.map(
        lambda a, b: bool((a != b).any()), state.params.policy, first.params.policy
    )
    assert all(jax.tree.leaves(moved))
    assert float(state.obs_moments.count) == 2 * NUM_ENVS * LENGTH


def test_it_averages_what_it_says(case: Case) -> None:
    sizes: list[int] = []

    class Counting(LocalCollectives):
        def mean(self, tree: Any, after: Any = None) -> Any:
            sizes.append(sum(leaf.size for leaf in jax.tree.leaves(tree)))
            return super().mean(tree, after)

    iterate = partial(case.algorithm.iterate, ENV, case.learner, Counting(), ENV.model)
    jax.eval_shape(iterate, case.first(0), case.memory())
    assert max(sizes) == case.algorithm.num_averaged(ENV.spec, case.config.algo)
    # Updates of SAC are of the critics or of the policy.
    assert len(set(sizes)) == (2 if case.config.algo.name == "sac" else 1)


def test_runs_that_share_a_program_learn_what_they_do_alone(case: Case) -> None:
    states, envs = [case.first(seed) for seed in (1, 2)], [case.memory(seed) for seed in (1, 2)]
    alone = jax.jit(
        partial(case.algorithm.iterate, ENV, case.learner, LocalCollectives(), ENV.model)
    )
    together = jax.jit(
        partial(
            iterate_all, case.algorithm.iterate, ENV, case.learner, LocalCollectives(), ENV.model
        )
    )
    stack = jax.jit(lambda trees: jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees))
    found, _, _ = together(stack(states), stack(envs))
    for number, (state, own) in enumerate(zip(states, envs, strict=True)):
        expected, _, _ = alone(state, own)
        mine = jax.tree.map(lambda leaf, k=number: leaf[k], found.params)
        chex.assert_trees_all_close(mine, expected.params, rtol=1e-4, atol=1e-5)


def test_it_goes_on_from_a_checkpoint_as_if_it_had_not_stopped(case: Case, tmp_path: Path) -> None:
    algorithm, learner = case.algorithm, case.learner
    iterate: Any = jax.jit(partial(algorithm.iterate, ENV, learner, LocalCollectives(), ENV.model))
    state, memory = case.first(5), case.memory(5)
    for _ in range(3):
        state, memory, _ = iterate(state, memory)
    run = RunPaths(tmp_path)
    write_json(run.config, to_dict(case.config))
    saver = CheckpointSaver(0, SingleRankCommunicator(), None)
    meta = checkpoint_meta(case.config, 96, 1, Standing())
    parts = state, algorithm.envs(memory), algorithm.replay(learner, memory)
    own, envs, replay = map(on_host, parts)
    saver.begin([CheckpointPart(run, meta, own, envs, replay=replay)])
    saver.finish()
    saver.stop()
    checkpoint = run.checkpoint(96)
    again = restore_learner(checkpoint, case.first(6))
    new = case.memory(6)
    other = algorithm.begin(learner, ENV, restore_envs(checkpoint, 0, algorithm.envs(new)))
    assert has_replay(checkpoint, 0) == (replay is not None)
    if replay is not None:
        template = algorithm.replay(learner, new)
        other = algorithm.with_replay(other, restore_replay(checkpoint, 0, template))
    expected, found = iterate(state, memory), iterate(again, other)
    chex.assert_trees_all_equal(on_host(found), on_host(expected))


def test_its_checkpoint_is_restored_and_acts(case: Case, tmp_path: Path) -> None:
    run, state = RunPaths(tmp_path), case.first(3)
    write_json(run.config, to_dict(case.config))
    save_learner(run, 32, on_host(state))
    save_policy(run, 32, case.config.env, case.config.algo, on_host(state))
    meta = checkpoint_meta(case.config, 32, 1, Standing())
    checkpoint = finish_checkpoint(run, meta)
    restored = restore_learner(checkpoint, case.first(4))
    chex.assert_trees_all_equal(restored.params, state.params)
    obs = np.linspace(-1.0, 1.0, 3 * ENV.spec.obs_size, dtype=np.float32).reshape(3, -1)
    weights = acting_weights(case.learner, state)
    acted = case.learner.networks.action_mean(weights.params, obs)
    np.testing.assert_allclose(
        trained_policy(checkpoint).act(obs), jnp.clip(acted, -1.0, 1.0), rtol=1e-5, atol=1e-6
    )
