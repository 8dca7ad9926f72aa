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
    return rotate(quat * jnp.array([1.0, -1.0, -1.0, -1.0]), vector)


def roll_and_yaw(quat: Array) -> tuple[Array, Array]:
    """Roll and yaw of intrinsic z-y-x angles, each in (-pi, pi] radians."""
    w, x, y, z = quat
    roll = jnp.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    yaw = jnp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, yaw


def wrap(angle: Array) -> Array:
    """`angle` in [-pi, pi) radians."""
    return (angle + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
