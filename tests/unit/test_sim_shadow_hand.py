from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gmijax.sim import physics, rotations, simulators
from gmijax.sim.interface import Env
from gmijax.sim.rewards import total_reward
from gmijax.sim.tasks import shadow_hand
from gmijax.sim.tasks.settings import ShadowHandSettings

NUM_KEYS = 64
CUBE = slice(24, 31)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return simulators.load("shadow_hand", impl="jax", substeps=shadow_hand.SUBSTEPS).mj_model


@pytest.fixture(scope="module")
def frozen_env() -> Iterator[Env]:
    """The task where nothing moves: only what the task adds to physics is left."""

    def stand_still(sim, model, state, ctrl, read):
        zeros = jnp.zeros((shadow_hand.NUM_TIPS, 13)), jnp.zeros((shadow_hand.NUM_TIPS, 6))
        return state, shadow_hand.Touch(jnp.zeros(24), *zeros)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(physics.Physics, "step", stand_still)
        env = shadow_hand.make(impl="jax")
        yield env._replace(reset=jax.jit(env.reset), step=jax.jit(env.step))


def keys(seed: int) -> jax.Array:
    return jax.random.split(jax.random.key(seed), NUM_KEYS)


def random_pose(model: mujoco.MjModel, seed: int) -> mujoco.MjData:
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[:24] = rng.uniform(*model.jnt_range[:24].T)
    data.qpos[27:31] = rng.normal(size=4)
    data.qpos[27:31] /= np.linalg.norm(data.qpos[27:31])
    data.qvel[:] = rng.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    return data


def test_actions_drive_the_actuators_between_their_limits(model):
    ids = shadow_hand.look_up(model)
    names = [shadow_hand.JOINTS[number] for number in shadow_hand.DRIVEN]
    assert names == [model.actuator(i).name for i in range(model.nu)]
    for action, limit in ((-1.0, 0), (1.0, 1)):
        targets = shadow_hand.targets_of(ids, jnp.full(20, action))
        np.testing.assert_allclose(targets, model.actuator_ctrlrange[:, limit], atol=1e-6)


def test_rotations_are_turns_about_y_then_about_x():
    quats = jax.vmap(shadow_hand.draw_rotation)(keys(0))
    np.testing.assert_allclose(jnp.linalg.norm(quats, axis=1), 1.0, atol=1e-6)
    # Of a turn about x after one about y: the world's y never gets to the cube's x axis.
    x_axes = jax.vmap(rotations.rotate)(quats, jnp.tile(jnp.array([1.0, 0.0, 0.0]), (NUM_KEYS, 1)))
    y_axes = jax.vmap(rotations.rotate)(quats, jnp.tile(jnp.array([0.0, 1.0, 0.0]), (NUM_KEYS, 1)))
    np.testing.assert_allclose(y_axes[:, 0], 0.0, atol=1e-6)
    assert float(x_axes[:, 0].min()) < -0.8
    assert float(x_axes[:, 0].max()) > 0.8


def test_a_start_has_coupled_joints_a_nearly_flat_hand_and_the_cube_above_it(model):
    ids = shadow_hand.look_up(model)
    qpos = jax.vmap(lambda key: shadow_hand.draw_start(ids, model, key, ShadowHandSettings()))(
        keys(1)
    )
    assert (qpos[:, ids.joints.qpos] >= 0.2 * ids.joints.lower).all()
    assert (qpos[:, ids.joints.qpos] <= 0.2 * ids.joints.upper).all()
    for equality in range(model.neq):
        follower, leader = (
            model.jnt_qposadr[objects[equality]] for objects in (model.eq_obj1id, model.eq_obj2id)
        )
        np.testing.assert_array_equal(qpos[:, follower], qpos[:, leader])
    offset = np.abs(qpos[:, 24:27] - np.array([0.0, -0.39, 0.6]))
    assert 0.008 < offset.max() <= 0.01 + 1e-6
    assert len(np.unique(qpos, axis=0)) == NUM_KEYS


@pytest.mark.parametrize("seed", [0, 1])
def test_fingertips_are_where_mujoco_has_them(model, seed: int):
    ids, data = shadow_hand.look_up(model), random_pose(model, seed)
    tips = shadow_hand.tips_of(ids, jnp.array(data.xpos), jnp.array(data.xquat), jnp.zeros((5, 6)))
    for tip, name in zip(np.asarray(tips), shadow_hand.TIPS, strict=True):
        site, rotation = data.site(f"{name}_tip"), np.zeros(9)
        np.testing.assert_allclose(tip[:3], site.xpos, atol=1e-6)
        mujoco.mju_quat2Mat(rotation, tip[3:7].astype(float))
        np.testing.assert_allclose(rotation, site.xmat, atol=1e-5)


def test_the_cubes_angular_velocity_is_seen_from_the_environment(model):
    ids, data = shadow_hand.look_up(model), random_pose(model, 3)
    state = physics.PhysicsState(*(jnp.array(x) for x in (data.qpos, data.qvel, data.qvel)))
    expected, body = np.zeros(6), model.body("cube").id
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, expected, 0)
    cube = shadow_hand.cube_of(ids, state)
    np.testing.assert_allclose(cube.angular_velocity, expected[:3], atol=1e-5)
    np.testing.assert_allclose(cube.velocity, expected[3:], atol=1e-5)


def test_reward_by_hand(model):
    ids = shadow_hand.look_up(model)
    qpos = np.array(model.qpos0, np.float32)
    qpos[CUBE] = [0.03, -0.39, 0.60, *np.asarray(rotations.turn(jnp.array([0.0, 0.0, 1.0]), 0.4))]
    state = physics.PhysicsState(jnp.array(qpos), jnp.zeros(model.nv), jnp.zeros(model.nv))
    identity, action = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.full(20, 0.5)
    view = shadow_hand.view_of(ids, state, identity, action, 0.1)
    # 3 cm beside and 4 cm above the goal; 0.4 rad away from it; twenty actions of 0.5.
    reward, terms = total_reward(shadow_hand.TERMS, view)
    assert float(reward) == pytest.approx(-0.5 + 2.0 - 0.001, abs=1e-4)
    assert float(terms["success"]) == 0.0


def test_a_reached_goal_pays_and_only_then_another_one_is_drawn(frozen_env: Env):
    state = frozen_env.reset(frozen_env.model, jax.random.key(4))
    step, action = frozen_env.step, jnp.zeros(20)
    missed = step(frozen_env.model, state, action)
    assert float(missed.reward_terms["success"]) == float(missed.metrics["successes"]) == 0.0
    np.testing.assert_array_equal(missed.task.goal, state.task.goal)
    assert missed.key == state.key
    # The goal as the cube lies, the other way round: the same rotation.
    same = state.task._replace(goal=-state.physics.qpos[27:31])
    reached = step(frozen_env.model, state._replace(task=same), action)
    assert float(reached.reward_terms["success"]) == 250.0
    assert float(reached.metrics["successes"]) == 1.0
    assert float(reached.metrics["rotation_error_rad"]) < 0.01
    assert not reached.terminated
    assert reached.key != state.key
    assert float(jnp.abs(reached.task.goal - same.goal).max()) > 0.01
    np.testing.assert_array_equal(reached.obs[88:92], reached.task.goal)
    again = reached.task._replace(goal=state.physics.qpos[27:31])
    twice = step(frozen_env.model, reached._replace(task=again), action)
    assert float(twice.metrics["successes"]) == 2.0


def test_a_cube_that_fell_ends_the_episode(frozen_env: Env):
    state = frozen_env.reset(frozen_env.model, jax.random.key(5))
    for height, fallen in ((0.33, False), (0.31, True)):  # the goal is at 0.56, the limit 0.24
        qpos = state.physics.qpos.at[24:27].set(jnp.array([0.0, -0.39, height]))
        moved = state._replace(physics=state.physics._replace(qpos=qpos))
        assert bool(frozen_env.step(frozen_env.model, moved, jnp.zeros(20)).terminated) is fallen


def test_the_observation_of_a_start_knows_the_fingertips_and_is_clipped(frozen_env: Env):
    state = frozen_env.reset(frozen_env.model, jax.random.key(6))
    data = mujoco.MjData(frozen_env.mj_model)
    data.qpos[:] = state.physics.qpos
    mujoco.mj_forward(frozen_env.mj_model, data)
    tips = np.asarray(state.obs[96:161]).reshape(5, 13)
    expected = [data.site(f"{name}_tip").xpos for name in shadow_hand.TIPS]
    np.testing.assert_allclose(tips[:, :3], expected, atol=1e-5)
    assert (tips[:, 7:] == 0.0).all()
    np.testing.assert_allclose(state.obs[72:79], state.physics.qpos[CUBE], atol=1e-6)
    np.testing.assert_allclose(state.obs[85:88], shadow_hand.GOAL_M)
    fast = state.physics._replace(qvel=jnp.full(30, 100.0))
    after = frozen_env.step(frozen_env.model, state._replace(physics=fast), jnp.ones(20))
    np.testing.assert_array_equal(after.obs[24:48], 5.0)
    np.testing.assert_array_equal(after.obs[191:], 1.0)


def test_the_cube_stays_in_a_hand_that_fidgets_and_contacts_stay_below_their_cap(model):
    data, rng = random_pose(model, 7), np.random.default_rng(7)
    mujoco.mj_resetData(model, data)
    cap = int(model.numeric("max_contact_points").data[0])
    middle, half = model.actuator_ctrlrange.mean(axis=1), np.ptp(model.actuator_ctrlrange, axis=1)
    for i in range(1200):
        if i % shadow_hand.SUBSTEPS == 0:
            data.ctrl[:] = middle + half * 0.1 * rng.normal(size=model.nu)
        mujoco.mj_step(model, data)
        assert np.sum(data.contact.dist < 0.0) <= cap
        if i > 60:  # the fall from 6 cm above the palm is over
            assert data.contact.dist.min(initial=0.0) > -0.008
            assert np.abs(data.qvel).max() < 30.0
            assert 0.5 < data.body("cube").xpos[2] < 0.6
