"""Addresses in a MuJoCo model by name, looked up once when a task is made."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

Addresses = npt.NDArray[np.int64]


def sensor_addresses(mj_model: mujoco.MjModel, names: Sequence[str]) -> Addresses:
    """Where the values of sensors `names`, one after the other, lie in `sensordata`."""
    spans = [(mj_model.sensor(name).adr[0], mj_model.sensor(name).dim[0]) for name in names]
    return np.concatenate([np.arange(start, start + size) for start, size in spans])


def joint_addresses(mj_model: mujoco.MjModel, names: Sequence[str]) -> tuple[Addresses, Addresses]:
    """Where hinge and slide joints `names` lie in `qpos` and in `qvel`."""
    joints = [mj_model.joint(name) for name in names]
    return (
        np.array([joint.qposadr[0] for joint in joints]),
        np.array([joint.dofadr[0] for joint in joints]),
    )


def free_joint_addresses(mj_model: mujoco.MjModel, name: str) -> tuple[int, int]:
    """Where a free joint starts in `qpos` (7 long) and in `qvel` (6 long)."""
    joint = mj_model.joint(name)
    return int(joint.qposadr[0]), int(joint.dofadr[0])


def joint_ranges(
    mj_model: mujoco.MjModel, names: Sequence[str]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Lower and upper limits of joints `names`, radians or metres."""
    ranges = np.array([mj_model.joint(name).range for name in names], np.float32)
    return ranges[:, 0], ranges[:, 1]
