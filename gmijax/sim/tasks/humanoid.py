"""Humanoid: run along +x on two legs (paper Table 6; figures of Isaac Gym, arXiv:2108.10470).

Observation [108]: torso height 1; linear and angular velocity in the torso's frame 3 + 3; yaw,
roll, angle to target 3; upright projection 1; heading projection 1; joint positions, -1 to 1
between their limits 21; joint velocities 21; joint forces 21; forces and torques at the feet 12;
last action 21.
Action [21]: joint torques, each joint with a gear of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.arrays import array_module, constant
from gmijax.sim import draws, episode, simulators
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.rewards import Replacement, RewardTerm, term_names, total_reward, with_weights
from gmijax.sim.tasks import runner
from gmijax.sim.tasks.runner import RunnerPose
from gmijax.sim.tasks.settings import HumanoidSettings, settings_from
from gmijax.types import Array, PRNGKey, PyTree

DEFAULT_EPISODE_LENGTH = 1000
SUBSTEPS = 4
# Random actions stay below 100, the sensors of a landing foot included.
MAX_ABS_OBS = 500.0
OBS_SIZE = 108
OBS_TERMS = (
    *runner.TORSO_TERMS,
    ("joint_position", 21),
    ("joint_velocity", 21),
    ("joint_torque", 21),
    ("foot_force_and_torque", 12),
    ("last_action", 21),
)
ACTION_SIZE = 21
ANGULAR_VELOCITY_SCALE = 0.25
JOINT_VELOCITY_SCALE = 0.1
FORCE_SCALE = 0.01
NEAR_LIMIT = 0.98

SIDES = ("right", "left")
LEG = ("hip_x", "hip_z", "hip_y", "knee", "ankle_y", "ankle_x")
ARM = ("shoulder1", "shoulder2", "elbow")
JOINTS = (
    *("abdomen_z", "abdomen_y", "abdomen_x"),
    *(f"{side}_{joint}" for limb in (LEG, ARM) for side in SIDES for joint in limb),
)
SENSORS = tuple(f"{side}_foot_{kind}" for side in SIDES for kind in ("force", "torque"))


class HumanoidView(NamedTuple):
    """What the reward terms read.

    Attributes:
      pose: where the step led to.
      action: [21] clipped.
      speed_m_per_s: [] towards the target.
      strength: [21] gear of every joint's motor, as a share of the strongest one's.
    """

    pose: RunnerPose
    action: Array
    speed_m_per_s: Array
    strength: Array


def energy(view: HumanoidView) -> Array:
    """Sum over the joints of what their motors do, in units of the strongest motor."""
    velocities = JOINT_VELOCITY_SCALE * view.pose.joint_velocities
    return (abs(view.action * velocities) * view.strength).sum()


def joint_limits(view: HumanoidView) -> Array:
    """Sum over the joints of how deep they are in the last 2 % before a limit, 1 at the limit."""
    depth = (abs(view.pose.joints) - NEAR_LIMIT).clip(0.0) / (1.0 - NEAR_LIMIT)
    return (depth * view.strength).sum()


TERMS = {
    "progress": RewardTerm[HumanoidView](lambda v: v.speed_m_per_s, 1.0),
    "alive": RewardTerm[HumanoidView](lambda v: 1.0, 2.0),
    "upright": RewardTerm[HumanoidView](lambda v: runner.upright_bonus(v.pose), 0.1),
    "heading": RewardTerm[HumanoidView](lambda v: runner.heading_bonus(v.pose), 0.5),
    "action": RewardTerm[HumanoidView](lambda v: (v.action**2).sum(), -0.01),
    "energy": RewardTerm[HumanoidView](energy, -0.05),
    "joint_limits": RewardTerm[HumanoidView](joint_limits, -0.25),
}
DEATH = "death"


def make(
    *,
    impl: str = "auto",
    max_envs: int | None = None,
    rewards: Mapping[str, float] | None = None,
    settings: Mapping[str, float] | None = None,
) -> Env:
    """Makes the task without its time limit; see `gmijax.sim.registry.make_env`."""
    terms, chosen = with_weights(TERMS, rewards), settings_from(HumanoidSettings, settings)
    sim = simulators.load("humanoid", impl=impl, substeps=SUBSTEPS, max_envs=max_envs)
    ids = runner.look_up(sim.mj_model, JOINTS, SENSORS)
    strength = motor_strength(sim.mj_model)
    spec = EnvSpec(
        name="humanoid",
        obs_size=OBS_SIZE,
        action_size=ACTION_SIZE,
        control_dt_s=sim.control_dt_s,
        episode_length=DEFAULT_EPISODE_LENGTH,
        reward_terms=term_names(terms, DEATH),
        max_abs_obs=MAX_ABS_OBS,
        metrics=(runner.SPEED,),
        obs_terms=OBS_TERMS,
    )

    def reset(model: PyTree, key: PRNGKey) -> EnvState:
        key, draw = draws.split(key)
        start = sim.start(*runner.draw_start(ids, sim.mj_model, draw, chosen))
        # Forces read zero: a reset runs no physics, see `Physics.start`.
        zeros = constant(np.zeros(ACTION_SIZE))
        sensors = constant(np.zeros(len(ids.sensors)))
        obs = observe(runner.pose_of(ids, start), zeros, sensors, zeros)
        return episode.begin(spec, start, (), obs, key)

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        action = action.clip(-1.0, 1.0)
        moved, (forces, sensors) = sim.step(
            model,
            state.physics,
            action,
            lambda data: (data.qfrc_actuator[ids.joints.qvel], data.sensordata[ids.sensors]),
        )
        pose = runner.pose_of(ids, moved)
        speed = runner.speed_to_target(state.physics, moved, sim.control_dt_s)
        view = HumanoidView(pose, action, speed, constant(strength))
        dead = pose.position[2] < chosen.death_height_m
        reward = total_reward(terms, view, Replacement(DEATH, dead, chosen.death_reward))
        obs = observe(pose, forces, sensors, action)
        metrics = {runner.SPEED: runner.mean_speed(pose, state.steps + 1, sim.control_dt_s)}
        return episode.advance(state, moved, (), obs, reward, dead, metrics)

    return sim.env(spec, reset, step)


def motor_strength(mj_model: mujoco.MjModel) -> npt.NDArray[np.float32]:
    """Gear of every joint's motor [21], as a share of the strongest one's."""
    gears = np.array([mj_model.actuator(joint).gear[0] for joint in JOINTS], np.float32)
    return gears / gears.max()


def observe(pose: RunnerPose, joint_forces: Array, foot_sensors: Array, action: Array) -> Array:
    """The observation [108].

    Args:
      pose: of the torso and the joints.
      joint_forces: [21] torques of the motors, N m.
      foot_sensors: [12] force and torque at either foot, N and N m.
      action: [21] the last action.
    """
    xp = array_module(pose.position)
    return xp.concatenate(
        [
            pose.position[2:],
            pose.velocity,
            ANGULAR_VELOCITY_SCALE * pose.angular_velocity,
            xp.stack([pose.yaw, pose.roll, pose.angle_to_target, pose.upright, pose.heading]),
            pose.joints,
            JOINT_VELOCITY_SCALE * pose.joint_velocities,
            FORCE_SCALE * joint_forces,
            FORCE_SCALE * foot_sensors,
            action,
        ]
    )
