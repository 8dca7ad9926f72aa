"""Ant: run along +x on four legs (paper Table 5; figures of Isaac Gym's Ant, arXiv:2108.10470).

Observation [60]: torso height 1; linear and angular velocity in the torso's frame 3 + 3; yaw,
roll, angle to target 3; upright projection 1; heading projection 1; joint positions, -1 to 1
between their limits 8; joint velocities 8; forces and torques at the feet 24; last action 8.
Action [8]: joint torques, hip then ankle of legs 1 to 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.sim import episode, lookup, physics, rotations
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.rewards import Replacement, RewardTerm, term_names, total_reward
from gmijax.types import Array, PRNGKey, PyTree

DEFAULT_EPISODE_LENGTH = 1000
SUBSTEPS = 3
# A running ant stays below 100, the sensors of a landing foot included.
MAX_ABS_OBS = 500.0
OBS_SIZE = 60
ACTION_SIZE = 8
TARGET_M = (1000.0, 0.0)
DEATH_HEIGHT_M = 0.31
DEATH_REWARD = -2.0
JOINT_VELOCITY_SCALE = 0.2
FOOT_SENSOR_SCALE = 0.1
JOINT_NOISE_RAD = 0.2
VELOCITY_NOISE_RAD_PER_S = 0.1

JOINTS = tuple(f"{joint}_{leg}" for leg in range(1, 5) for joint in ("hip", "ankle"))
SENSORS = tuple(f"foot_{leg}_{kind}" for leg in range(1, 5) for kind in ("force", "torque"))


@dataclass(frozen=True)
class AntIds:
    """Addresses in the model and the joints' limits.

    Attributes:
      joint_qpos: [8] where the joints lie in `qpos`.
      joint_qvel: [8] where they lie in `qvel`.
      sensors: [24] where the feet's forces and torques lie in `sensordata`.
      lower: [8] lower limits, radians.
      upper: [8] upper limits, radians.
    """

    joint_qpos: lookup.Addresses
    joint_qvel: lookup.Addresses
    sensors: lookup.Addresses
    lower: npt.NDArray[np.float32]
    upper: npt.NDArray[np.float32]


class AntPose(NamedTuple):
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
      joints: [8] positions, -1 at the lower limit and 1 at the upper one.
      joint_velocities: [8] scaled by `JOINT_VELOCITY_SCALE`.
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


class AntView(NamedTuple):
    """What the reward terms read: the step's outcome, its action, and the speed to the target."""

    pose: AntPose
    action: Array
    speed_m_per_s: Array


TERMS = {
    "progress": RewardTerm[AntView](lambda v: v.speed_m_per_s, 1.0),
    "alive": RewardTerm[AntView](lambda v: jnp.ones(()), 0.5),
    "upright": RewardTerm[AntView](lambda v: (v.pose.upright > 0.93).astype(jnp.float32), 0.1),
    "heading": RewardTerm[AntView](lambda v: jnp.minimum(v.pose.heading / 0.8, 1.0), 0.5),
    "action": RewardTerm[AntView](lambda v: jnp.sum(v.action**2), -0.005),
    "energy": RewardTerm[AntView](
        lambda v: jnp.sum(jnp.abs(v.action * v.pose.joint_velocities)), -0.05
    ),
    "joint_limits": RewardTerm[AntView](
        lambda v: jnp.sum(v.pose.joints > 0.99, dtype=jnp.float32), -0.1
    ),
}
DEATH = "death"


def make(*, impl: str = "auto", max_envs: int | None = None) -> Env:
    """Makes the task without its time limit; see `gmijax.sim.registry.make_env`."""
    world = physics.load("ant", impl=impl, substeps=SUBSTEPS, max_envs=max_envs)
    ids = look_up(world.mj_model)
    spec = EnvSpec(
        name="ant",
        obs_size=OBS_SIZE,
        action_size=ACTION_SIZE,
        control_dt_s=world.control_dt_s,
        episode_length=DEFAULT_EPISODE_LENGTH,
        reward_terms=term_names(TERMS, DEATH),
        max_abs_obs=MAX_ABS_OBS,
    )

    def reset(model: PyTree, key: PRNGKey) -> EnvState:
        del model  # nothing that a reset draws depends on it
        key, draw = jax.random.split(key)
        start = world.start(*draw_start(ids, world.mj_model, draw))
        # The feet's sensors read zero: to fill them in would take a whole physics step, and an
        # automatic reset happens, under `where`, in every step of every world.
        zeros = jnp.zeros(len(ids.sensors)), jnp.zeros(ACTION_SIZE)
        return episode.begin(spec, start, (), observe(pose_of(ids, start), *zeros), key)

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        action = jnp.clip(action, -1.0, 1.0)
        moved, sensordata = world.step(model, state.physics, action)
        pose = pose_of(ids, moved)
        view = AntView(pose, action, speed_to_target(state.physics, moved, world.control_dt_s))
        dead = pose.position[2] < DEATH_HEIGHT_M
        reward = total_reward(TERMS, view, Replacement(DEATH, dead, DEATH_REWARD))
        obs = observe(pose, sensordata[ids.sensors], action)
        return episode.advance(state, moved, (), obs, reward, dead)

    return Env(
        spec=spec,
        model=world.model,
        reset=reset,
        step=step,
        mj_model=world.mj_model,
        qpos=lambda state: state.physics.qpos,
        max_envs=world.max_envs,
    )


def look_up(mj_model: mujoco.MjModel) -> AntIds:
    """Finds the model's addresses by name."""
    return AntIds(
        *lookup.joint_addresses(mj_model, JOINTS),
        lookup.sensor_addresses(mj_model, SENSORS),
        *lookup.joint_ranges(mj_model, JOINTS),
    )


def draw_start(ids: AntIds, mj_model: mujoco.MjModel, key: PRNGKey) -> tuple[Array, Array]:
    """Random `qpos` [15] and `qvel` [14]: the torso in its place, noise on the joints only."""
    position_key, velocity_key = jax.random.split(key)
    shape, noise = (ACTION_SIZE,), JOINT_NOISE_RAD
    rest = np.clip(np.zeros(shape, np.float32), ids.lower, ids.upper)
    joints = rest + jax.random.uniform(position_key, shape, minval=-noise, maxval=noise)
    noise = VELOCITY_NOISE_RAD_PER_S
    velocities = jax.random.uniform(velocity_key, shape, minval=-noise, maxval=noise)
    qpos = jnp.array(mj_model.qpos0, jnp.float32)
    qpos = qpos.at[ids.joint_qpos].set(jnp.clip(joints, ids.lower, ids.upper))
    return qpos, jnp.zeros(mj_model.nv).at[ids.joint_qvel].set(velocities)


def pose_of(ids: AntIds, state: physics.PhysicsState) -> AntPose:
    """Derives the pose from positions and velocities alone."""
    position, quat = state.qpos[:3], state.qpos[3:7]
    roll, yaw = rotations.roll_and_yaw(quat)
    to_target = jnp.array(TARGET_M) - position[:2]
    # The figures' source takes the target's height for its y here. That makes the angle blind
    # to drifting sideways, which can only be an oversight.
    angle = jnp.arctan2(to_target[1], to_target[0]) - yaw
    forward = rotations.rotate(quat, jnp.array([1.0, 0.0, 0.0]))
    joints = state.qpos[ids.joint_qpos]
    return AntPose(
        position=position,
        velocity=rotations.rotate_back(quat, state.qvel[:3]),
        angular_velocity=state.qvel[3:6],
        yaw=yaw,
        roll=roll,
        angle_to_target=rotations.wrap(angle),
        upright=1.0 - 2.0 * (quat[1] ** 2 + quat[2] ** 2),
        heading=forward[:2] @ to_target / jnp.linalg.norm(to_target),
        joints=(2.0 * joints - ids.upper - ids.lower) / (ids.upper - ids.lower),
        joint_velocities=JOINT_VELOCITY_SCALE * state.qvel[ids.joint_qvel],
    )


def speed_to_target(
    before: physics.PhysicsState, after: physics.PhysicsState, dt_s: float
) -> Array:
    """Decrease of the distance to the target per second, m/s."""
    old, new = (jnp.array(TARGET_M) - state.qpos[:2] for state in (before, after))
    moved = after.qpos[:2] - before.qpos[:2]
    # |old| - |new| as a quotient: in float32 the difference of two numbers near 1000 m is off by
    # 0.1 mm, which is 7 mm/s here.
    return moved @ (old + new) / (jnp.linalg.norm(old) + jnp.linalg.norm(new)) / dt_s


def observe(pose: AntPose, foot_sensors: Array, action: Array) -> Array:
    """The observation [60] from the pose, raw foot sensors [24] and the last action [8]."""
    return jnp.concatenate(
        [
            pose.position[2:],
            pose.velocity,
            pose.angular_velocity,
            jnp.stack([pose.yaw, pose.roll, pose.angle_to_target, pose.upright, pose.heading]),
            pose.joints,
            pose.joint_velocities,
            FOOT_SENSOR_SCALE * foot_sensors,
            action,
        ]
    )
