"""Rotations of single vectors by unit quaternions (w, x, y, z), as MuJoCo has them."""

from __future__ import annotations

import jax.numpy as jnp

from gmijax.types import Array


def rotate(quat: Array, vector: Array) -> Array:
    """`vector` [3] of the body frame `quat` [4], seen from the world."""
    scalar, axis = quat[0], quat[1:]
    twice = 2.0 * jnp.cross(axis, vector)
    return vector + scalar * twice + jnp.cross(axis, twice)


def rotate_back(quat: Array, vector: Array) -> Array:
    """`vector` [3] of the world, seen from the body frame `quat` [4]."""
    return rotate(conjugate(quat), vector)


def conjugate(quat: Array) -> Array:
    """The opposite rotation [4] of `quat` [4]."""
    return quat * jnp.array([1.0, -1.0, -1.0, -1.0])


def product(second: Array, first: Array) -> Array:
    """The rotation [4] by `first` [4] and then by `second` [4], both about the world's axes."""
    a, b = second[1:], first[1:]
    scalar = second[0] * first[0] - jnp.sum(a * b)
    return jnp.append(scalar, second[0] * b + first[0] * a + jnp.cross(a, b))


def turn(axis: Array, angle_rad: Array) -> Array:
    """The rotation [4] by `angle_rad` about the unit vector `axis` [3]."""
    return jnp.append(jnp.cos(0.5 * angle_rad), jnp.sin(0.5 * angle_rad) * axis)


def angle(quat: Array) -> Array:
    """By how much `quat` [4] turns about its axis, 0 to pi radians; the shorter way round."""
    return 2.0 * jnp.arctan2(jnp.linalg.norm(quat[1:]), jnp.abs(quat[0]))


def roll_and_yaw(quat: Array) -> tuple[Array, Array]:
    """Roll and yaw of intrinsic z-y-x angles, each in (-pi, pi] radians."""
    w, x, y, z = quat
    roll = jnp.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    yaw = jnp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, yaw


def wrap(angle: Array) -> Array:
    """`angle` in [-pi, pi) radians."""
    return (angle + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
