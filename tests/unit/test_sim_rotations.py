import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.sim import rotations

QUARTER_TURN_LEFT = jnp.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])


def test_quarter_turn_to_the_left_takes_x_to_y_and_back():
    x = jnp.array([1.0, 0.0, 0.0])
    turned = rotations.rotate(QUARTER_TURN_LEFT, x)
    np.testing.assert_allclose(turned, [0.0, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(rotations.rotate_back(QUARTER_TURN_LEFT, turned), x, atol=1e-6)


@pytest.mark.parametrize("angle", [-3.0, -0.5, 0.0, 1.2, 3.1])
def test_roll_and_yaw_of_turns_about_one_axis(angle: float):
    half_cos, half_sin = np.cos(angle / 2), np.sin(angle / 2)
    about_x, about_z = ([half_cos, half_sin, 0.0, 0.0], [half_cos, 0.0, 0.0, half_sin])
    np.testing.assert_allclose(rotations.roll_and_yaw(jnp.array(about_x)), (angle, 0.0), atol=1e-5)
    np.testing.assert_allclose(rotations.roll_and_yaw(jnp.array(about_z)), (0.0, angle), atol=1e-5)


def test_wrap_brings_angles_into_one_turn():
    angles = jnp.array([0.0, 4.0, -4.0, 7.0])
    expected = [0.0, 4.0 - 2 * np.pi, 2 * np.pi - 4.0, 7.0 - 2 * np.pi]
    np.testing.assert_allclose(rotations.wrap(angles), expected, atol=1e-5)
