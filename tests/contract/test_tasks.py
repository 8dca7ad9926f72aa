"""What every task must do, over all entries of the registry; MuJoCo in C is the oracle.

A task's programs are compiled once, for `NUM_ENVS` environments, and shared by all tests.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compile_options import CPU_OPTIONS
from task_cases import CASES, OracleLimit

from gmijax.sim import physics
from gmijax.sim.interface import Env
from gmijax.sim.registry import TASKS, make_env
from gmijax.sim.wrappers import BatchedEnv, BatchState, StepOutput, env_keys, training_env

NUM_ENVS = 8
EPISODE_LENGTH = 25
# Halves the time to compile; other devices do not know the option.


class Task(NamedTuple):
    """One task with its compiled programs; `traces` grows by one whenever step is traced."""

    env: Env
    batch: BatchedEnv
    init: Callable[[Any, jax.Array], BatchState]
    step: Callable[[Any, BatchState, jax.Array], tuple[BatchState, StepOutput]]
    traces: list[int]

    def start(self, seed: int = 0) -> BatchState:
        return self.init(self.env.model, env_keys(jax.random.key(seed), 0, NUM_ENVS))

    def actions(self, seed: int) -> jax.Array:
        shape = (NUM_ENVS, self.env.spec.action_size)
        return jax.random.uniform(jax.random.key(seed), shape, minval=-1.0, maxval=1.0)


@pytest.fixture(scope="module", params=sorted(TASKS))
def task(request: pytest.FixtureRequest) -> Task:
    env = make_env(request.param, impl="jax", episode_length=EPISODE_LENGTH)
    batch = training_env(env)
    traces: list[int] = []

    def counted(model: Any, state: BatchState, actions: jax.Array) -> Any:
        traces.append(1)
        return batch.step(model, state, actions)

    step = jax.jit(counted, compiler_options=CPU_OPTIONS)
    return Task(env, batch, jax.jit(batch.init), step, traces)


def test_shapes_and_dtypes_are_those_of_the_spec(task: Task):
    spec = task.env.spec
    state, out = jax.eval_shape(task.batch.step, task.env.model, task.start(), task.actions(0))
    for obs in (state.env.obs, out.next_obs):
        assert (obs.shape, obs.dtype) == ((NUM_ENVS, spec.obs_size), jnp.float32)
    assert (out.reward.shape, out.reward.dtype) == ((NUM_ENVS,), jnp.float32)
    for flag in (out.terminated, out.truncated):
        assert (flag.shape, flag.dtype) == ((NUM_ENVS,), jnp.bool_)
    assert spec.action_size == task.env.mj_model.nu
    assert set(state.env.reward_terms) == set(spec.reward_terms)
    assert set(out.finished.term_sums) == set(spec.reward_terms)
    assert set(state.env.metrics) == set(spec.metrics) == set(out.finished.metric_sums)
    assert spec.episode_length == EPISODE_LENGTH
    assert jax.eval_shape(task.env.qpos, state.env).shape == (NUM_ENVS, task.env.mj_model.nq)


def test_equal_keys_give_equal_resets_and_different_keys_different_ones(task: Task):
    first, again, other = task.start(0), task.start(0), task.start(1)
    np.testing.assert_array_equal(first.env.obs, again.env.obs)
    assert not np.array_equal(first.env.obs, other.env.obs)
    assert len(np.unique(first.env.obs, axis=0)) == NUM_ENVS


def test_random_steps_stay_finite_and_rewards_are_the_sum_of_their_terms(task: Task):
    state = task.start()
    returns = terms = ended = 0.0
    for i in range(200):
        state, out = task.step(task.env.model, state, task.actions(i))
        assert np.isfinite(out.next_obs).all()
        assert np.isfinite(out.reward).all()
        going_on = np.asarray(state.env.steps) > 0
        summed = np.sum([np.asarray(v) for v in state.env.reward_terms.values()], axis=0)
        np.testing.assert_allclose(summed[going_on], out.reward[going_on], atol=1e-5)
        returns += float(out.finished.return_sum)
        terms += sum(float(value) for value in out.finished.term_sums.values())
        ended += int(out.finished.count)
    assert ended >= NUM_ENVS * (200 // EPISODE_LENGTH)
    assert returns == pytest.approx(terms, rel=1e-4, abs=1e-2)


def test_time_limit_truncates_and_a_new_random_episode_begins(task: Task):
    first = state = task.start()
    actions = jnp.zeros_like(task.actions(0))
    alive = np.ones(NUM_ENVS, bool)
    for _ in range(EPISODE_LENGTH - 1):
        state, out = task.step(task.env.model, state, actions)
        assert not out.truncated.any()
        alive &= ~np.asarray(out.terminated)
    state, out = task.step(task.env.model, state, actions)
    assert not (out.terminated & out.truncated).any()
    alive &= ~np.asarray(out.terminated)
    assert alive.any()
    np.testing.assert_array_equal(out.truncated, alive)
    # The outcome belongs to the old episode, the state to the new one.
    assert (np.asarray(state.env.steps)[alive] == 0).all()
    new_obs, last_obs = np.asarray(state.env.obs)[alive], np.asarray(out.next_obs)[alive]
    assert not np.isclose(new_obs, last_obs).all(axis=1).any()
    assert not np.isclose(new_obs, np.asarray(first.env.obs)[alive]).all(axis=1).any()
    assert int(out.finished.count) == alive.sum() + int(out.terminated.sum())
    assert int(out.finished.length_sum) == alive.sum() * EPISODE_LENGTH


def test_a_fatal_position_terminates_its_own_world_only(task: Task):
    hazard = CASES[task.env.spec.name].hazard
    if hazard is None:
        pytest.skip("only time ends this task")
    state = task.start()
    moved = state.env.physics._replace(qpos=hazard(state.env.physics.qpos))
    actions = task.actions(0)
    _, untouched = task.step(task.env.model, state, actions)
    fallen = state._replace(env=state.env._replace(physics=moved))
    after, out = task.step(task.env.model, fallen, actions)
    assert out.terminated.tolist() == [True] + [False] * (NUM_ENVS - 1)
    assert not out.truncated.any()
    assert int(out.finished.count) == 1
    assert after.env.steps.tolist() == [0] + [1] * (NUM_ENVS - 1)
    np.testing.assert_array_equal(out.next_obs[1:], untouched.next_obs[1:])
    if "death" in task.env.spec.reward_terms:
        assert float(out.reward[0]) == float(out.finished.term_sums["death"])


def test_step_is_traced_once(task: Task):
    state = task.start(seed=5)
    for i in range(2):
        state, _ = task.step(task.env.model, state, task.actions(i))
    assert len(task.traces) == 1


def test_one_physics_step_is_that_of_mujoco_in_c(task: Task):
    limit = CASES[task.env.spec.name].oracle
    # Both solvers are run to the end: cut off early, as in training, they stop at different
    # places on the way to the same answer.
    mj_model = physics.load(task.env.spec.name, impl="jax", substeps=1).mj_model
    mj_model.opt.iterations = mj_model.opt.ls_iterations = 50
    world = physics.from_mj_model(mj_model, impl="jax", substeps=1)
    before, ctrl, after, sensors = c_trajectory(mj_model, limit)
    step = jax.jit(jax.vmap(world.step, in_axes=(None, 0, 0)), compiler_options=CPU_OPTIONS)
    state, sensordata = step(world.model, before, ctrl)
    np.testing.assert_allclose(state.qvel, after.qvel, rtol=1e-4, atol=limit.qvel)
    np.testing.assert_allclose(state.qpos, after.qpos, rtol=1e-4, atol=limit.qvel * 0.01)
    np.testing.assert_allclose(sensordata, sensors, rtol=1e-4, atol=limit.sensors)


def c_trajectory(
    mj_model: mujoco.MjModel, limit: OracleLimit
) -> tuple[physics.PhysicsState, jax.Array, physics.PhysicsState, jax.Array]:
    """States before and after every step [T, ...], its controls, and its sensors."""
    data, rng = mujoco.MjData(mj_model), np.random.default_rng(0)
    rows = []
    for i in range(limit.steps):
        if i % 8 == 0:
            data.ctrl = rng.uniform(-limit.ctrl, limit.ctrl, mj_model.nu)
        before = (data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy())
        mujoco.mj_step(mj_model, data)
        after = (data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy())
        rows.append((before, data.ctrl.copy(), after, data.sensordata.copy()))

    def stack(*values: Any) -> jax.Array:
        return jnp.asarray(np.stack(values), jnp.float32)

    before, ctrl, after, sensors = jax.tree.map(stack, *rows)
    return physics.PhysicsState(*before), ctrl, physics.PhysicsState(*after), sensors
