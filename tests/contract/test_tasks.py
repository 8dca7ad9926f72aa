"""What every task must do, over all entries of the registry; MuJoCo in C is the oracle.

A task's programs are compiled once, for `NUM_ENVS` environments, and shared by all tests.
"""

from __future__ import annotations

import dataclasses
import importlib
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiled_tasks import EPISODE_LENGTH, NUM_ENVS, NUM_STARTS, CompiledTask, on_device
from mujoco import mjx
from task_cases import CASES, OracleLimit

from gmijax.cli.compose import compose
from gmijax.sim import physics
from gmijax.sim.randomize import randomized
from gmijax.sim.registry import TASKS
from gmijax.sim.rewards import RewardTerm
from gmijax.sim.tasks.settings import CURRICULA, SETTINGS
from gmijax.sim.wrappers import BatchState, StepOutput


def test_equal_keys_give_equal_resets_and_all_are_different_and_within_limits(task: CompiledTask):
    first, again, other = task.start(0), task.start(0), task.start(1)
    np.testing.assert_array_equal(first.env.obs, again.env.obs)
    assert not np.array_equal(first.env.obs, other.env.obs)
    assert len(np.unique(first.env.obs, axis=0)) == NUM_ENVS
    limited = task.mj_model.jnt_limited.astype(bool)
    joints = np.asarray(first.env.physics.qpos)[:, task.mj_model.jnt_qposadr[limited]]
    lower, upper = task.mj_model.jnt_range[limited].T
    assert ((joints >= lower - 1e-6) & (joints <= upper + 1e-6)).all()


def test_random_steps_stay_finite_and_rewards_are_the_sum_of_their_terms(task: CompiledTask):
    state = task.start()
    returns = terms = ended = 0.0
    for i in range(200):
        state, out = task.step(task.env.model, state, task.actions(i))
        if i == 0:
            check_shapes(task, state, out)
        assert np.isfinite(out.next_obs).all()
        assert np.isfinite(out.reward).all()
        assert not any(int(count) for count in out.overflowed.values())
        going_on = np.asarray(state.env.steps) > 0
        summed = np.sum([np.asarray(v) for v in state.env.reward_terms.values()], axis=0)
        np.testing.assert_allclose(summed[going_on], out.reward[going_on], atol=1e-5)
        returns += float(out.finished.return_sum)
        terms += sum(float(value) for value in out.finished.term_sums.values())
        ended += int(out.finished.count)
    assert ended >= NUM_ENVS * (200 // EPISODE_LENGTH)
    assert returns == pytest.approx(terms, rel=1e-4, abs=1e-2)
    assert len(task.traces) == 1


def check_shapes(task: CompiledTask, state: BatchState, out: StepOutput) -> None:
    """Shapes, dtypes and names are those of the spec."""
    spec = task.env.spec
    for obs in (state.env.obs, out.next_obs):
        assert (obs.shape, obs.dtype) == ((NUM_ENVS, spec.obs_size), jnp.float32)
    assert (out.reward.shape, out.reward.dtype) == ((NUM_ENVS,), jnp.float32)
    for flag in (out.terminated, out.truncated):
        assert (flag.shape, flag.dtype) == ((NUM_ENVS,), jnp.bool_)
    assert spec.action_size == task.env.mj_model.nu
    assert set(state.env.reward_terms) == set(spec.reward_terms) == set(out.finished.term_sums)
    assert set(state.env.metrics) == set(spec.metrics) == set(out.finished.metric_sums)
    assert spec.episode_length == EPISODE_LENGTH
    assert task.env.qpos(state.env).shape == (NUM_ENVS, task.env.mj_model.nq)


def test_time_limit_truncates_and_a_new_random_episode_begins(task: CompiledTask):
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


def test_a_fatal_position_terminates_its_own_environment_only(task: CompiledTask):
    hazard = CASES[task.env.spec.name].hazard
    if hazard is None:
        pytest.skip("only time ends this task")
    state = task.start()
    (at, numbers), qpos = hazard, state.env.physics.qpos
    there = qpos.at[0, at : at + len(numbers)].set(jnp.array(numbers))
    moved = state.env.physics._replace(qpos=there)
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


def test_the_ranges_of_its_randomisation_fit_its_model(task: CompiledTask):
    config = compose(f"env={task.env.spec.name}", "env.randomize=on").env
    assert config.randomize == "on"
    many = randomized(task.env, config.randomization, seed=0, first_env=0, num_envs=2)
    for leaf in config.randomization:
        values = np.asarray(getattr(many.model, leaf))
        assert not np.array_equal(values[0], values[1])


def test_every_setting_is_read_and_terms_without_weight_are_not_traced(
    task: CompiledTask, monkeypatch: pytest.MonkeyPatch
):
    name = task.env.spec.name
    module, read = importlib.import_module(TASKS[name]), set()

    class Recorded(SETTINGS[name]):
        def __getattribute__(self, key: str) -> Any:
            read.add(key)
            return super().__getattribute__(key)

    def untraced(view: Any) -> Any:
        raise AssertionError

    def unmoved(world: physics.Physics, _: Any, state: Any, __: Any, read: Any = None) -> Any:
        data = mjx.make_data(world.model)
        return state, data.sensordata if read is None else read(data)

    # What moves a world, and takes most of the time to trace, reads no settings.
    monkeypatch.setattr(physics.Physics, "step", unmoved)
    settings, terms = Recorded(), {key: RewardTerm(untraced, 1.0) for key in module.TERMS}
    read.clear()  # Of the checks of a new one.
    monkeypatch.setattr(module, "settings_from", lambda cls, given: settings)
    monkeypatch.setattr(module, "TERMS", terms)
    curriculum = {"curriculum": True} if name in CURRICULA else {}
    env = module.make(impl=task.impl, max_envs=1, rewards=dict.fromkeys(terms, 0.0), **curriculum)
    state = jax.eval_shape(env.reset, env.model, jax.random.key(0))
    jax.eval_shape(env.step, env.model, state, task.actions(0)[0])
    if curriculum:
        assert jax.eval_shape(env.next_episode, env.model, state) == state
    assert env.spec.reward_terms == task.env.spec.reward_terms
    assert {field.name for field in dataclasses.fields(settings)} <= read


def test_one_physics_step_is_that_of_mujoco_in_c(task: CompiledTask):
    limit = CASES[task.env.spec.name].oracle
    before, ctrl, after, sensors = c_trajectory(task.converged.mj_model, limit)
    state, sensordata = converged_steps(task, before, ctrl)
    np.testing.assert_allclose(state.qvel, after.qvel, rtol=1e-4, atol=limit.qvel)
    np.testing.assert_allclose(state.qpos, after.qpos, rtol=1e-4, atol=limit.qvel * 0.01)
    np.testing.assert_allclose(sensordata, sensors, rtol=1e-4, atol=limit.sensors)


def converged_steps(
    task: CompiledTask, before: physics.PhysicsState, ctrl: jax.Array
) -> tuple[physics.PhysicsState, jax.Array]:
    """One step of each state [T, ...], in the batches that the task's program was compiled for."""
    num, after = len(ctrl), []
    for first in range(0, num, NUM_STARTS):
        # What is missing in the last batch is there twice.
        rows = np.minimum(np.arange(first, first + NUM_STARTS), num - 1)
        batch = on_device(jax.tree.map(lambda leaf, rows=rows: leaf[rows], before))
        after.append(task.converged_step(task.converged.model, batch, ctrl[rows]))
    return jax.tree.map(lambda *batches: np.concatenate(batches)[:num], *after)


def c_trajectory(
    mj_model: mujoco.MjModel, limit: OracleLimit
) -> tuple[physics.PhysicsState, jax.Array, physics.PhysicsState, jax.Array]:
    """States before and after every step [T, ...], its controls, and its sensors.

    It starts at the model's keyframe, if there is one, and controls are drawn around those of it.
    """
    data, rng = mujoco.MjData(mj_model), np.random.default_rng(0)
    if mj_model.nkey:
        mujoco.mj_resetDataKeyframe(mj_model, data, 0)
    rest = data.ctrl.copy()
    rows = []
    for i in range(limit.steps):
        if i % 8 == 0:
            data.ctrl = rest + rng.uniform(-limit.ctrl, limit.ctrl, mj_model.nu)
        before = (data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy())
        mujoco.mj_step(mj_model, data)
        after = (data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy())
        rows.append((before, data.ctrl.copy(), after, data.sensordata.copy()))

    def stack(*values: Any) -> jax.Array:
        return jnp.asarray(np.stack(values), jnp.float32)

    before, ctrl, after, sensors = jax.tree.map(stack, *rows)
    return physics.PhysicsState(*before), ctrl, physics.PhysicsState(*after), sensors
