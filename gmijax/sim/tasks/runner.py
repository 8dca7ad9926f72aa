"""What the tasks share whose robot runs along +x: its start, its pose, its progress.

Their models have a free joint first, with the torso upright at x = 0, and limited hinges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from gmijax.arrays import array_module, constant, replaced
from gmijax.sim import draws, rotations
from gmijax.sim.physics_state import PhysicsState
from gmijax.sim.tasks import lookup
from gmijax.sim.tasks.settings import RunnerSettings
from gmijax.types import Array, PRNGKey

TARGET_M = constant([1000.0, 0.0])
X_AXIS = constant([1.0, 0.0, 0.0])
UPRIGHT = 0.93
AHEAD = 0.8
SPEED = "speed_m_per_s"
"""The metric of these tasks: `mean_speed` over the episode."""

TORSO_TERMS = (
    ("torso_height", 1),
    ("torso_velocity", 3),
    ("torso_angular_velocity", 3),
    ("yaw", 1),
    ("roll", 1),
    ("angle_to_target", 1),
    ("upright", 1),
    ("heading", 1),
)
"""With what their observations begin."""


@dataclass(frozen=True)
class RunnerIds:
    """Addresses in the model of a robot.

    Attributes:
      joints: the J driven ones.
      sensors: [6 F] where the forces and torques of F feet lie in `sensordata`.
    """

    joints: lookup.Joints
    sensors: lookup.Addresses


class RunnerPose(NamedTuple):
    """What observation and reward derive from positions and velocities.

    Attributes:
      position: [3] torso in the world, metres.
      velocity: [3] of the torso in its own frame, m/s.
      angular_velocity: [3] of the torso in its own frame, rad/s.
      yaw: [] rad.
      roll: [] rad.
      angle_to_target: [] rad, from where the torso looks to where the target is.
      upright: [] z component of the torso's up axis, 1 when level.
      heading: [] cosine between the torso's x axis and the way to the target.
      joints: [J] positions, -1 at the lower limit and 1 at the upper one.
      joint_velocities: [J] rad/s.
    """

    position: Array
    velocity: Array
    angular_velocity: Array
    yaw: Array
    roll: Array
    angle_to_target: Array
    upright: Array
    heading: Array
    joints: Array
    joint_velocities: Array


def look_up(mj_model: mujoco.MjModel, joints: Sequence[str], sensors: Sequence[str]) -> RunnerIds:
    """Finds the addresses of `joints` and of the feet's `sensors` by name."""
    return RunnerIds(
        lookup.find_joints(mj_model, joints), lookup.sensor_addresses(mj_model, sensors)
    )


def draw_start(
    ids: RunnerIds, mj_model: mujoco.MjModel, key: PRNGKey, settings: RunnerSettings
) -> tuple[Array, Array]:
    """Random `qpos` [nq] and `qvel` [nv]: the torso where it starts, noise on the joints only."""
    position_key, velocity_key = draws.split(key)
    lower, upper = ids.joints.lower, ids.joints.upper
    shape, noise = lower.shape, settings.joint_noise_rad
    rest = np.clip(np.zeros(shape, np.float32), lower, upper)
    joints = rest + draws.uniform(position_key, shape, minval=-noise, maxval=noise)
    noise = settings.joint_velocity_noise_rad_per_s
    velocities = draws.uniform(velocity_key, shape, minval=-noise, maxval=noise)
    joints = joints.clip(lower, upper)
    return (
        replaced(mj_model.qpos0.astype(np.float32), ids.joints.qpos, joints),
        replaced(np.zeros(mj_model.nv, np.float32), ids.joints.qvel, velocities),
    )


def pose_of(ids: RunnerIds, state: PhysicsState) -> RunnerPose:
    """Derives the pose from positions and velocities alone."""
    xp = array_module(state.qpos)
    position, quat = state.qpos[:3], state.qpos[3:7]
    roll, yaw = rotations.roll_and_yaw(quat)
    to_target = TARGET_M - position[:2]
    # The figures' source takes the target's height for its y here. That makes the angle blind
    # to drifting sideways, which can only be an oversight.
    angle = xp.arctan2(to_target[1], to_target[0]) - yaw
    forward = rotations.rotate(quat, X_AXIS)
    joints = state.qpos[ids.joints.qpos]
    return RunnerPose(
        position=position,
        velocity=rotations.rotate_back(quat, state.qvel[:3]),
        angular_velocity=state.qvel[3:6],
        yaw=yaw,
        roll=roll,
        angle_to_target=rotations.wrap(angle),
        upright=1.0 - 2.0 * (quat[1] ** 2 + quat[2] ** 2),
        heading=forward[:2] @ to_target / xp.linalg.norm(to_target),
        joints=ids.joints.scaled(joints),
        joint_velocities=state.qvel[ids.joints.qvel],
    )


def speed_to_target(before: PhysicsState, after: PhysicsState, dt_s: float) -> Array:
    """Decrease of the distance to the target per second, m/s."""
    xp = array_module(after.qpos)
    old, new = (TARGET_M - state.qpos[:2] for state in (before, after))
    moved = after.qpos[:2] - before.qpos[:2]
    # |old| - |new| as a quotient: in float32 the difference of two numbers near 1000 m is off by
    # 0.1 mm, which is 7 mm/s here.
    return moved @ (old + new) / (xp.linalg.norm(old) + xp.linalg.norm(new)) / dt_s


def mean_speed(pose: RunnerPose, steps: Array, dt_s: float) -> Array:
    """Mean speed along +x since the start at x = 0, `steps` [] steps ago, m/s."""
    return pose.position[0] / (steps * dt_s)


def upright_bonus(pose: RunnerPose) -> Array:
    """1 while the torso is nearly upright, else 0."""
    return (pose.upright > UPRIGHT).astype(np.float32)


def heading_bonus(pose: RunnerPose) -> Array:
    """1 while the torso looks at the target or nearly so, less and below 0 as it turns away."""
    return array_module(pose.heading).minimum(pose.heading / AHEAD, 1.0)
