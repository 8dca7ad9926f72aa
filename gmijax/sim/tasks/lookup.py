"""Addresses in a MuJoCo model by name, looked up once when a task is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.types import Array

Addresses = npt.NDArray[np.int64]


def sensor_addresses(mj_model: mujoco.MjModel, names: Sequence[str]) -> Addresses:
    """Where the values of sensors `names`, one after the other, lie in `sensordata`."""
    spans = [(mj_model.sensor(name).adr[0], mj_model.sensor(name).dim[0]) for name in names]
    return np.concatenate([np.arange(start, start + size) for start, size in spans])


@dataclass(frozen=True)
class Joints:
    """Addresses and limits of J hinge and slide joints.

    Attributes:
      qpos: [J] where they lie in `qpos`.
      qvel: [J] where they lie in `qvel`.
      lower: [J] lower limits, radians or metres.
      upper: [J] upper limits.
    """

    qpos: Addresses
    qvel: Addresses
    lower: npt.NDArray[np.float32]
    upper: npt.NDArray[np.float32]

    def scaled(self, positions: Array) -> Array:
        """`positions` [J], -1 at the lower limit and 1 at the upper one."""
        return (2.0 * positions - self.upper - self.lower) / (self.upper - self.lower)


def find_joints(mj_model: mujoco.MjModel, names: Sequence[str]) -> Joints:
    """The hinge and slide joints `names`."""
    joints = [mj_model.joint(name) for name in names]
    ranges = np.array([joint.range for joint in joints], np.float32)
    return Joints(
        np.array([joint.qposadr[0] for joint in joints]),
        np.array([joint.dofadr[0] for joint in joints]),
        ranges[:, 0],
        ranges[:, 1],
    )


def free_joint_addresses(mj_model: mujoco.MjModel, name: str) -> tuple[int, int]:
    """Where a free joint starts in `qpos` (7 long) and in `qvel` (6 long)."""
    joint = mj_model.joint(name)
    return int(joint.qposadr[0]), int(joint.dofadr[0])
