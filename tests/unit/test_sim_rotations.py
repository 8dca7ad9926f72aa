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


def test_product_turns_by_the_first_and_then_by_the_second():
    x, z = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0])
    left, over = rotations.turn(z, np.pi / 2), rotations.turn(x, np.pi / 2)
    np.testing.assert_allclose(left, QUARTER_TURN_LEFT, atol=1e-6)
    # Left takes x to y, then over takes y to z; over leaves x, then left takes x to y.
    both = rotations.rotate(rotations.product(over, left), x)
    np.testing.assert_allclose(both, [0.0, 0.0, 1.0], atol=1e-6)
    both = rotations.rotate(rotations.product(left, over), x)
    np.testing.assert_allclose(both, [0.0, 1.0, 0.0], atol=1e-6)


def test_a_rotation_and_its_conjugate_cancel():
    quat = jnp.array([0.1, -0.7, 0.5, 0.5])
    none = rotations.product(quat, rotations.conjugate(quat))
    np.testing.assert_allclose(none, [1.0, 0.0, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("turned", "expected"), [(0.0, 0.0), (0.002, 0.002), (-2.0, 2.0), (3.1, 3.1), (4.0, 2.283185)]
)
def test_angle_is_that_of_the_shorter_way_round_whatever_the_sign(turned: float, expected: float):
    quat = rotations.turn(jnp.array([0.6, 0.0, -0.8]), turned)
    for same in (quat, -quat):
        assert float(rotations.angle(same)) == pytest.approx(expected, abs=1e-5)
