"""Rotations, against those of MuJoCo in C."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gmijax.sim import rotations


@pytest.mark.parametrize("seed", range(3))
def test_rotations_are_those_of_mujoco(seed: int):
    rng = np.random.default_rng(seed)
    first, second = rng.normal(size=(2, 4))
    first, second = first / np.linalg.norm(first), second / np.linalg.norm(second)
    vector, axis, angle = rng.normal(size=3), np.array([0.6, 0.0, -0.8]), rng.uniform(-3, 3)
    turned, both, turn = np.zeros(3), np.zeros(4), np.zeros(4)
    mujoco.mju_rotVecQuat(turned, vector, first)
    mujoco.mju_mulQuat(both, second, first)
    mujoco.mju_axisAngle2Quat(turn, axis, angle)
    quats = jnp.array(first), jnp.array(second)
    np.testing.assert_allclose(rotations.rotate(quats[0], jnp.array(vector)), turned, atol=1e-5)
    np.testing.assert_allclose(rotations.rotate_back(quats[0], turned), vector, atol=1e-5)
    np.testing.assert_allclose(rotations.product(quats[1], quats[0]), both, atol=1e-5)
    np.testing.assert_allclose(rotations.turn(jnp.array(axis), angle), turn, atol=1e-5)


@pytest.mark.parametrize("angle", [-3.0, -0.5, 0.0, 1.2, 3.1])
def test_roll_and_yaw_of_turns_about_one_axis(angle: float):
    half_cos, half_sin = np.cos(angle / 2), np.sin(angle / 2)
    about_x, about_z = ([half_cos, half_sin, 0.0, 0.0], [half_cos, 0.0, 0.0, half_sin])
    np.testing.assert_allclose(rotations.roll_and_yaw(jnp.array(about_x)), (angle, 0.0), atol=1e-5)
    np.testing.assert_allclose(rotations.roll_and_yaw(jnp.array(about_z)), (0.0, angle), atol=1e-5)
    assert float(rotations.wrap(jnp.array(angle + 4 * np.pi))) == pytest.approx(angle, abs=1e-5)


@pytest.mark.parametrize(
    ("turned", "expected"), [(0.0, 0.0), (0.002, 0.002), (-2.0, 2.0), (3.1, 3.1), (4.0, 2.283185)]
)
def test_angle_is_that_of_the_shorter_way_round_whatever_the_sign(turned: float, expected: float):
    quat = rotations.turn(jnp.array([0.6, 0.0, -0.8]), turned)
    for same in (quat, -quat):
        assert float(rotations.angle(same)) == pytest.approx(expected, abs=1e-5)
