"""SAC with the agent in a GMI of its own, without processes: it learns as one program does."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from functools import partial
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
from gmijax.learning.learner import acting_weights, num_weights
from gmijax.learning.start import begin_episodes
from gmijax.machine.snapshot import detect_machine
from gmijax.sac.decoupled import SAC
from gmijax.sac.replay import kind_of
from gmijax.sac.sac import SAC as IN_TURN
from gmijax.supervise.job_kinds import training_plan

ENV = point_mass()
APART = "plan.serving_gmis_per_gpu=1"
TINY = (
    *("env=ball_balance", "algo=sac", "num_envs=16", "algo.batch_size=64", "plan.backend=cpu"),
    *("algo.critic_hidden_layer_sizes=[32,32]", "algo.policy_hidden_layer_sizes=[32,32]"),
    *("algo.replay_steps=64", "algo.updates_per_step=2", "algo.reward_scaling=0.5"),
    *("algo.unroll_length=1", "algo.policy_every=2"),
)


def started(*overrides: str) -> tuple[Any, Any, Any]:
    """Learner, its first state and environments."""
    learner = IN_TURN.make_learner(ENV.spec, gmijax.compose(*TINY, *overrides).algo)
    state = jax.jit(partial(SAC.init, learner, ENV.spec.obs_size))(jax.random.key(0))
    return learner, state, begin_episodes(ENV, jax.random.key(1), 0, 16, kept_steps=64)


def copied(tree: Any) -> Any:
    return jax.tree.map(jnp.copy, tree)


def apart(learner: Any, state: Any, envs: Any, lag: int, iterations: int) -> Iterator[Any]:
    """Agent and learner in turn; the agent acts with weights that are `lag` versions old."""
    update = SAC.make_update(learner, ENV.spec, 16, SingleRankCommunicator())
    update.compile(state)
    length = learner.config.unroll_length
    collect: Any = jax.jit(partial(SAC.collect, ENV, learner.networks, length))
    weights = deque([copied(acting_weights(learner, state))] * (lag + 1), lag + 1)
    for _ in range(iterations):
        envs, steps, counts = collect(ENV.model, weights[0], envs)
        state, updated = update(state, steps._asdict(), None)
        weights.append(copied(acting_weights(learner, state)))
        yield state, updated, counts


@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_from_the_same_experience_the_learner_becomes_what_one_program_makes(
    precision: str,
) -> None:
    learner, state, envs = started(f"algo.replay_precision={precision}")
    memory = IN_TURN.begin(learner, ENV, envs)
    iterate: Any = jax.jit(partial(IN_TURN.iterate, ENV, learner, LocalCollectives(), ENV.model))
    whole = copied(state)
    for number, (mine, updated, counts) in enumerate(apart(learner, state, envs, 0, 14), start=1):
        whole, memory, metrics = iterate(whole, memory)
        assert int(mine.updates) == 2 * max(0, number - 9)  # `learning_starts` is 10.
        assert float(updated.figures["async/updates_per_step"]) == (2 if number > 9 else 0)
        chex.assert_trees_all_close(counts, metrics.counts, rtol=1e-5, atol=1e-5)
        chex.assert_trees_all_close(mine.obs_moments, whole.obs_moments, rtol=1e-5, atol=1e-5)
    for name in ("params", "critics", "targets", "log_temperature"):
        ours, theirs = getattr(mine, name), getattr(whole, name)
        chex.assert_trees_all_close(ours, theirs, rtol=1e-3, atol=1e-4)
    # Which it would not, had it learnt from anything else.
    critics = (jax.tree.leaves(one.critics) for one in (started()[1], whole))
    assert max(np.abs(a - b).max() for a, b in zip(*critics, strict=True)) > 1e-3


def test_an_unroll_is_followed_by_the_updates_of_all_its_steps() -> None:
    learner, state, envs = started("algo.unroll_length=4", "algo.policy_every=4", "algo.n_step=2")
    size = num_weights(ENV.spec, learner.config)
    for number, (after, updated, _) in enumerate(apart(learner, state, envs, 2, 4), start=1):
        assert int(after.updates) == 4 * 2 * max(0, number - 2)
        assert int(after.iteration) == number  # The version of the policy.
        assert float(after.obs_moments.count) == 4 * 16 * number
        assert float(updated.figures["replay/steps"]) == 4 * number
        assert updated.weights.shape == (size,)
        assert (float(updated.losses.critic_loss) > 0) == (number > 2)


def test_the_kinds_of_steps_survive_their_way() -> None:
    of = [jnp.asarray(one, bool) for one in ([0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1])]
    kind = kind_of(*of)
    ends = kind == 1, kind == 2
    np.testing.assert_array_equal(kind_of(*ends, jnp.zeros((), bool)), kind)


def test_with_a_policy_two_versions_old_it_learns_what_one_program_learns() -> None:
    rewards: dict[int, float] = {}
    for lag in (0, 2):
        learner, state, envs = started("algo.learning_rate=1e-3")
        _, updates, counts = zip(*apart(learner, state, envs, lag, 300), strict=True)
        rewards[lag] = float(np.mean([one.reward_sum for one in counts[-50:]])) / 16
        assert float(updates[-1].losses.end_atoms) < 0.05
    assert min(rewards.values()) > 0.5  # At first it is about -0.4.
    assert rewards[2] == pytest.approx(rewards[0], abs=0.15)


@pytest.mark.parametrize(
    ("overrides", "is_decoupled"),
    [
        ((), False),
        ((APART,), True),
        (("plan.serving_gpus=[0]", "plan.training_gpus=[0]"), True),
        (("plan.template=decoupled",), True),
        ((APART, "plan.template=tcg_ex"), False),
    ],
)
def test_who_asks_for_it_gets_one_agent_and_one_learner(
    overrides: tuple[str, ...], is_decoupled: bool
) -> None:
    config = gmijax.compose(*TINY, *overrides)
    assert config.is_decoupled == is_decoupled
    plan = training_plan(config, detect_machine())
    assert plan.layout.gmis_of_gpu == (((0, 1),) if is_decoupled else ((0,),))
    assert plan.roles == (
        ("trainer", "simulator+agent") if is_decoupled else ("simulator+agent+trainer",)
    )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ((APART, "plan.training_gmis_per_gpu=2"), "plan.training_gmis_per_gpu=2: .*one trains"),
        (("plan.serving_gmis_per_gpu=2",), "plan.serving_gmis_per_gpu=2: .* one GMI acts"),
        (("plan.serving_gmis_per_gpu=0",), "plan.serving_gmis_per_gpu=0: at least one GMI must"),
        (("plan.serving_gpus=1", "plan.training_gpus=1"), "plan.gpus=2: .* both on one GPU"),
        ((APART, "plan.gpus=2"), "plan.gpus=2: .* both on one GPU"),
        ((APART, "algo.save_replay=true"), "algo.save_replay=True: .* false where a GMI of its"),
        ((APART, "algo.unroll_length=3"), "algo.replay_steps=64: .* multiple of .*length=3"),
        ((APART, "num_envs=auto"), "num_envs=auto: nothing is searched for"),
        ((APART, "eval.every=100"), "eval.every=100: .* nobody evaluates"),
        ((APART, "cluster.engine=ray"), "cluster.engine=ray: .* on one machine"),
    ],
)
def test_what_it_is_not_for_is_refused(overrides: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        training_plan(gmijax.compose(*TINY, *overrides), detect_machine())
