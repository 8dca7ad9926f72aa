"""Rotations of vectors by unit quaternions (w, x, y, z), as MuJoCo has them.

On numpy as on JAX (`gmijax.arrays`).
"""

from __future__ import annotations

import math

import numpy as np

from gmijax.arrays import array_module, constant
from gmijax.types import Array

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
_CONJUGATE = constant([1.0, -1.0, -1.0, -1.0])


def _cross(a: Array, b: Array) -> Array:
    xp = array_module(a, b)
    if xp is np:  # Whose own takes longer than a physics step: it allows any axis.
        return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]
    return xp.cross(a, b)


def rotate(quat: Array, vector: Array) -> Array:
    """`vector` [..., 3] of the body frame `quat` [..., 4], seen from the world."""
    scalar, axis = quat[..., :1], quat[..., 1:]
    twice = 2.0 * _cross(axis, vector)
    return vector + scalar * twice + _cross(axis, twice)


def rotate_back(quat: Array, vector: Array) -> Array:
    """`vector` [3] of the world, seen from the body frame `quat` [4]."""
    return rotate(conjugate(quat), vector)


def conjugate(quat: Array) -> Array:
    """The opposite rotation [4] of `quat` [4]."""
    return quat * _CONJUGATE


def product(second: Array, first: Array) -> Array:
    """The rotation [4] by `first` [4] and then by `second` [4], both about the world's axes."""
    xp = array_module(second, first)
    a, b = second[1:], first[1:]
    scalar = second[0] * first[0] - xp.sum(a * b)
    return xp.append(scalar, second[0] * b + first[0] * a + _cross(a, b))


def turn(axis: Array, angle_rad: Array) -> Array:
    """The rotation [4] by `angle_rad` about the unit vector `axis` [3]."""
    xp = array_module(axis, angle_rad)
    return xp.append(xp.cos(0.5 * angle_rad), xp.sin(0.5 * angle_rad) * axis)


def angle(quat: Array) -> Array:
    """By how much `quat` [4] turns about its axis, 0 to pi radians; the shorter way round."""
    xp = array_module(quat)
    return 2.0 * xp.arctan2(xp.linalg.norm(quat[1:]), xp.abs(quat[0]))


def roll_and_yaw(quat: Array) -> tuple[Array, Array]:
    """Roll and yaw of intrinsic z-y-x angles, each in (-pi, pi] radians."""
    xp = array_module(quat)
    w, x, y, z = quat
    roll = xp.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    yaw = xp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, yaw


def wrap(angle: Array) -> Array:
    """`angle` in [-pi, pi) radians."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
