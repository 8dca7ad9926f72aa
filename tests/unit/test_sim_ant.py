import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.sim import physics
from gmijax.sim.tasks import ant
from gmijax.sim.tasks.settings import AntSettings


def state(qpos: np.ndarray, qvel: np.ndarray | None = None) -> physics.PhysicsState:
    zeros = jnp.zeros(14)
    return physics.PhysicsState(
        jnp.array(qpos, jnp.float32), zeros if qvel is None else jnp.array(qvel), zeros
    )


@pytest.fixture(scope="module")
def model():
    return physics.load("ant", impl="jax", substeps=ant.SUBSTEPS).mj_model


def test_speed_is_exact_a_kilometre_from_the_target(model):
    here, there = model.qpos0.copy(), model.qpos0.copy()
    there[0] += 0.001
    speed = ant.speed_to_target(state(here), state(there), dt_s=0.1)
    assert float(speed) == pytest.approx(0.01, rel=1e-4)


def test_velocity_is_seen_from_the_torso(model):
    qpos, qvel = model.qpos0.copy(), np.zeros(14, np.float32)
    qpos[3:7] = np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)  # a quarter turn to the left
    qvel[1] = 2.0  # along the world's y, which is straight ahead now
    pose = ant.pose_of(ant.look_up(model), state(qpos, qvel))
    np.testing.assert_allclose(pose.velocity, [2.0, 0.0, 0.0], atol=1e-6)
    assert float(pose.yaw) == pytest.approx(np.pi / 2)
    assert float(pose.angle_to_target) == pytest.approx(-np.pi / 2, abs=1e-3)
    assert float(pose.heading) == pytest.approx(0.0, abs=1e-3)
    assert float(pose.upright) == pytest.approx(1.0)


def test_joints_are_minus_one_and_one_at_their_limits(model):
    ids = ant.look_up(model)
    for limits, expected in ((ids.joints.lower, -1.0), (ids.joints.upper, 1.0)):
        qpos = model.qpos0.copy()
        qpos[ids.joints.qpos] = limits
        np.testing.assert_allclose(ant.pose_of(ids, state(qpos)).joints, expected, atol=1e-5)


def test_reset_noise_stays_within_the_limits(model):
    ids = ant.look_up(model)
    qpos, qvel = jax.vmap(lambda key: ant.draw_start(ids, model, key, AntSettings()))(
        jax.random.split(jax.random.key(0), 64)
    )
    joints = qpos[:, ids.joints.qpos]
    assert (joints >= ids.joints.lower).all()
    assert (joints <= ids.joints.upper).all()
    np.testing.assert_array_equal(qpos[:, :7], np.tile(model.qpos0[:7].astype("f4"), (64, 1)))
    assert float(jnp.abs(qvel).max()) <= 0.1
