"""Ant: run along +x on four legs (paper Table 6; figures of Isaac Gym's Ant, arXiv:2108.10470).

Observation [60]: torso height 1; linear and angular velocity in the torso's frame 3 + 3; yaw,
roll, angle to target 3; upright projection 1; heading projection 1; joint positions, -1 to 1
between their limits 8; joint velocities 8; forces and torques at the feet 24; last action 8.
Action [8]: joint torques, hip then ankle of legs 1 to 4.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from gmijax.arrays import array_module, constant
from gmijax.sim import draws, episode, simulators
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.rewards import Replacement, RewardTerm, term_names, total_reward, with_weights
from gmijax.sim.tasks import runner
from gmijax.sim.tasks.runner import RunnerPose
from gmijax.sim.tasks.settings import AntSettings, settings_from
from gmijax.types import Array, PRNGKey, PyTree

DEFAULT_EPISODE_LENGTH = 1000
SUBSTEPS = 3
# A running ant stays below 100, the sensors of a landing foot included.
MAX_ABS_OBS = 500.0
OBS_SIZE = 60
OBS_TERMS = (
    *runner.TORSO_TERMS,
    ("joint_position", 8),
    ("joint_velocity", 8),
    ("foot_force_and_torque", 24),
    ("last_action", 8),
)
ACTION_SIZE = 8
JOINT_VELOCITY_SCALE = 0.2
FOOT_SENSOR_SCALE = 0.1

JOINTS = tuple(f"{joint}_{leg}" for leg in range(1, 5) for joint in ("hip", "ankle"))
SENSORS = tuple(f"foot_{leg}_{kind}" for leg in range(1, 5) for kind in ("force", "torque"))


class AntView(NamedTuple):
    """What the reward terms read: the step's outcome, its action, and the speed to the target."""

    pose: RunnerPose
    action: Array
    speed_m_per_s: Array


TERMS = {
    "progress": RewardTerm[AntView](lambda v: v.speed_m_per_s, 1.0),
    "alive": RewardTerm[AntView](lambda v: 1.0, 0.5),
    "upright": RewardTerm[AntView](lambda v: runner.upright_bonus(v.pose), 0.1),
    "heading": RewardTerm[AntView](lambda v: runner.heading_bonus(v.pose), 0.5),
    "action": RewardTerm[AntView](lambda v: (v.action**2).sum(), -0.005),
    "energy": RewardTerm[AntView](
        lambda v: abs(v.action * (JOINT_VELOCITY_SCALE * v.pose.joint_velocities)).sum(),
        -0.05,
    ),
    "joint_limits": RewardTerm[AntView](
        lambda v: (v.pose.joints > 0.99).sum(dtype=np.float32), -0.1
    ),
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
    terms, chosen = with_weights(TERMS, rewards), settings_from(AntSettings, settings)
    sim = simulators.load("ant", impl=impl, substeps=SUBSTEPS, max_envs=max_envs)
    ids = runner.look_up(sim.mj_model, JOINTS, SENSORS)
    spec = EnvSpec(
        name="ant",
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
        # Sensors read zero: a reset runs no physics, see `Physics.start`.
        zeros = constant(np.zeros(len(ids.sensors))), constant(np.zeros(ACTION_SIZE))
        return episode.begin(spec, start, (), observe(runner.pose_of(ids, start), *zeros), key)

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        action = action.clip(-1.0, 1.0)
        moved, sensordata = sim.step(model, state.physics, action)
        pose = runner.pose_of(ids, moved)
        speed = runner.speed_to_target(state.physics, moved, sim.control_dt_s)
        view = AntView(pose, action, speed)
        dead = pose.position[2] < chosen.death_height_m
        reward = total_reward(terms, view, Replacement(DEATH, dead, chosen.death_reward))
        obs = observe(pose, sensordata[ids.sensors], action)
        metrics = {runner.SPEED: runner.mean_speed(pose, state.steps + 1, sim.control_dt_s)}
        return episode.advance(state, moved, (), obs, reward, dead, metrics)

    return sim.env(spec, reset, step)


def observe(pose: RunnerPose, foot_sensors: Array, action: Array) -> Array:
    """The observation [60] from the pose, raw foot sensors [24] and the last action [8]."""
    xp = array_module(pose.position)
    return xp.concatenate(
        [
            pose.position[2:],
            pose.velocity,
            pose.angular_velocity,
            xp.stack([pose.yaw, pose.roll, pose.angle_to_target, pose.upright, pose.heading]),
            pose.joints,
            JOINT_VELOCITY_SCALE * pose.joint_velocities,
            FOOT_SENSOR_SCALE * foot_sensors,
            action,
        ]
    )
