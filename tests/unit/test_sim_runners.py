"""The tasks whose robot runs along +x, `ant` and `humanoid`."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gmijax.sim import physics, simulators
from gmijax.sim.tasks import humanoid, lookup, runner
from gmijax.sim.tasks.settings import HumanoidSettings


@pytest.fixture(scope="module")
def model():
    return simulators.load("humanoid", impl="jax", substeps=humanoid.SUBSTEPS).mj_model


@pytest.fixture(scope="module")
def ids(model):
    return runner.look_up(model, humanoid.JOINTS, humanoid.SENSORS)


def state(qpos: np.ndarray, qvel: np.ndarray | None = None) -> physics.PhysicsState:
    zeros = jnp.zeros(27)
    return physics.PhysicsState(
        jnp.array(qpos, jnp.float32), zeros if qvel is None else jnp.array(qvel), zeros
    )


def view(**changes: np.ndarray) -> humanoid.HumanoidView:
    """A humanoid at rest whose motors have half the strength of the strongest one."""
    zeros = jnp.zeros(humanoid.ACTION_SIZE)
    pose = runner.RunnerPose(*[zeros] * len(runner.RunnerPose._fields))
    action = changes.pop("action", zeros)
    return humanoid.HumanoidView(pose._replace(**changes), action, zeros[0], 0.5 + zeros)


def test_motors_are_in_the_order_of_the_joints_and_push_as_their_gears_say(model, ids):
    assert tuple(model.actuator(i).name for i in range(model.nu)) == humanoid.JOINTS
    data = mujoco.MjData(model)
    data.ctrl[:] = np.linspace(-1.0, 1.0, model.nu)
    mujoco.mj_forward(model, data)
    torques = data.qfrc_actuator[ids.joints.qvel]
    strength = humanoid.motor_strength(model)
    np.testing.assert_allclose(torques, 135.0 * strength * data.ctrl, rtol=1e-6)
    assert strength[humanoid.JOINTS.index("left_hip_y")] == 1.0
    assert strength[humanoid.JOINTS.index("right_ankle_x")] == pytest.approx(1 / 6)


def test_energy_counts_what_motors_do_by_their_strength():
    ones = jnp.ones(humanoid.ACTION_SIZE)
    # 21 joints x |-1 x 0.1 x 2 rad/s| x 0.5
    assert float(humanoid.energy(view(action=-ones, joint_velocities=2.0 * ones))) == (
        pytest.approx(2.1)
    )


def test_joint_limits_cost_from_two_percent_before_them():
    joints = jnp.zeros(humanoid.ACTION_SIZE).at[:3].set(jnp.array([0.98, -0.99, 1.0]))
    # Half of the last 2 % and all of it, at half the strength.
    assert float(humanoid.joint_limits(view(joints=joints))) == pytest.approx(0.75, rel=1e-4)


def test_observation_has_the_documented_places(model, ids):
    pose = runner.pose_of(ids, state(model.qpos0, np.arange(27, dtype="f4")))
    forces, feet, action = jnp.full(21, 100.0), jnp.full(12, 200.0), jnp.full(21, 0.5)
    obs = humanoid.observe(pose, forces, feet, action)
    assert obs.shape == (humanoid.OBS_SIZE,)
    np.testing.assert_allclose(obs[:7], [1.34, 0.0, 1.0, 2.0, 0.75, 1.0, 1.25], rtol=1e-6)
    np.testing.assert_allclose(obs[7:12], [0.0, 0.0, 0.0, 1.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(obs[33:54], 0.1 * np.arange(6, 27), rtol=1e-6)
    np.testing.assert_allclose(obs[54:], [1.0] * 21 + [2.0] * 12 + [0.5] * 21)


def test_speed_is_exact_a_kilometre_from_the_target_and_means_are_over_time(model, ids):
    there = model.qpos0.copy()
    there[0] += 0.001
    speed = runner.speed_to_target(state(model.qpos0), state(there), dt_s=0.1)
    assert float(speed) == pytest.approx(0.01, rel=1e-4)
    there[0] = 3.0
    mean = runner.mean_speed(runner.pose_of(ids, state(there)), jnp.int32(90), 1 / 60)
    assert float(mean) == pytest.approx(2.0)


def test_velocity_is_seen_from_the_torso(model, ids):
    qpos, qvel = model.qpos0.copy(), np.zeros(27, np.float32)
    qpos[3:7] = np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)  # a quarter turn to the left
    qvel[1] = 2.0  # along the world's y, which is straight ahead now
    pose = runner.pose_of(ids, state(qpos, qvel))
    np.testing.assert_allclose(pose.velocity, [2.0, 0.0, 0.0], atol=1e-6)
    assert float(pose.yaw) == pytest.approx(np.pi / 2)
    assert float(pose.angle_to_target) == pytest.approx(-np.pi / 2, abs=1e-3)
    assert float(pose.heading) == pytest.approx(0.0, abs=1e-3)
    assert float(pose.upright) == pytest.approx(1.0)


def test_joints_are_minus_one_and_one_at_their_limits(model):
    joints = lookup.find_joints(model, humanoid.JOINTS)
    for limits, expected in ((joints.lower, -1.0), (joints.upper, 1.0)):
        np.testing.assert_allclose(joints.scaled(jnp.array(limits)), expected, atol=1e-5)


def test_a_kneeling_humanoid_rests_on_its_knees(model):
    data = mujoco.MjData(model)
    for side in humanoid.SIDES:
        data.joint(f"{side}_knee").qpos = np.deg2rad(-90.0)
        data.joint(f"{side}_ankle_y").qpos = np.deg2rad(50.0)
    data.qpos[2] = 0.88
    mujoco.mj_forward(model, data)
    touching = {model.geom(geom).name for contact in data.contact for geom in contact.geom}
    assert {"right_knee", "left_knee"} <= touching
    assert data.qpos[2] > HumanoidSettings().death_height_m


def test_what_is_only_seen_has_no_mass(model):
    assert model.body_mass.sum() == pytest.approx(40.844, abs=1e-3)
    assert model.body("torso").mass[0] == pytest.approx(8.907, abs=0.01)
