"""Anymal: a four-legged robot follows a commanded velocity (paper Table 6; figures of Isaac Gym).

Observation [48], each value clipped to +-5: linear and angular velocity in the base's frame
3 + 3; direction of gravity in it 3; commanded forward, sideways and yaw speed 3; joint positions
relative to standing 12; joint velocities 12; last action 12.
Action [12]: position targets of the joints relative to standing, HAA, HFE, KFE of the legs LF,
LH, RF, RH. Isaac Gym's paper: arXiv:2108.10470.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.arrays import array_module, constant, replaced
from gmijax.sim import draws, episode, rotations, simulators
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.physics_state import PhysicsState
from gmijax.sim.rewards import RewardTerm, term_names, total_reward, with_weights
from gmijax.sim.tasks import lookup
from gmijax.sim.tasks.settings import AnymalSettings, settings_from
from gmijax.types import Array, PRNGKey, PyTree

DEFAULT_EPISODE_LENGTH = 2500
SUBSTEPS = 4
OBS_SIZE = 48
OBS_TERMS = (
    ("base_velocity", 3),
    ("base_angular_velocity", 3),
    ("gravity_direction", 3),
    ("commanded_velocity", 2),
    ("commanded_yaw_rate", 1),
    ("joint_position", 12),
    ("joint_velocity", 12),
    ("last_action", 12),
)
ACTION_SIZE = 12
OBS_LIMIT = 5.0
VELOCITY_SCALE = 2.0
ANGULAR_VELOCITY_SCALE = 0.25
JOINT_VELOCITY_SCALE = 0.05
KNEE_RADIUS_M = 0.065
BASE_HALF_SIZE_M = constant([0.525, 0.16, 0.09])
DOWN = constant([0.0, 0.0, -1.0])
COMMAND_SCALES = constant([VELOCITY_SCALE, VELOCITY_SCALE, ANGULAR_VELOCITY_SCALE])

COMMAND_NAMES = ("forward_m_per_s", "left_m_per_s", "yaw_rad_per_s")

LEGS = ("LF", "LH", "RF", "RH")
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("HAA", "HFE", "KFE"))
SHANKS = tuple(f"{leg}_SHANK" for leg in LEGS)


class AnymalTask(NamedTuple):
    """The task's memory.

    Attributes:
      command: [3] wanted speed forwards and to the left, m/s, and of yaw, rad/s.
      velocity_error_sum: [] of the episode's steps so far, m/s.
      yaw_rate_error_sum: [] of the episode's steps so far, rad/s.
      share: [] of the commands' ranges that `command` was drawn from, carried on from episode to
        episode by the curriculum; None without one.
    """

    command: Array
    velocity_error_sum: Array
    yaw_rate_error_sum: Array
    share: Array | None = None


@dataclass(frozen=True)
class AnymalIds:
    """Addresses in the model and the pose in which the robot stands.

    Attributes:
      joints: the 12 driven ones.
      shanks: [4] bodies whose origins are the knees.
      standing: [12] joint positions, radians.
    """

    joints: lookup.Joints
    shanks: lookup.Addresses
    standing: npt.NDArray[np.float32]


class AnymalView(NamedTuple):
    """What the reward terms read.

    Attributes:
      velocity_error: [] distance of the horizontal velocity from the commanded one, m/s.
      yaw_rate_error: [] rad/s, not negative.
      torques: [12] of the joints' servos, N m.
    """

    velocity_error: Array
    yaw_rate_error: Array
    torques: Array


def closeness(error: Array) -> Array:
    """1 without an error, less with one."""
    return array_module(error).exp(-(error**2) / 0.25)


# The figures' source has weights of 1, 0.5 and 0.000025 per second; a step takes 0.02 s.
TERMS = {
    "velocity": RewardTerm[AnymalView](lambda v: closeness(v.velocity_error), 0.02),
    "yaw_rate": RewardTerm[AnymalView](lambda v: closeness(v.yaw_rate_error), 0.01),
    "torque": RewardTerm[AnymalView](lambda v: (v.torques**2).sum(), -0.0000005),
}
FLOOR = "floor"
METRICS: tuple[str, ...] = ("velocity_error_m_per_s", "yaw_rate_error_rad_per_s")
SHARE = "command_share"
"""The metric of the curriculum."""

SUCCESS_M_PER_S = 0.25
"""Largest mean velocity error of an episode that succeeds."""


def make(
    *,
    impl: str = "auto",
    max_envs: int | None = None,
    rewards: Mapping[str, float] | None = None,
    settings: Mapping[str, float] | None = None,
    curriculum: bool = False,
) -> Env:
    """Makes the task without its time limit; see `gmijax.sim.registry.make_env`.

    With `curriculum` the commands of an environment begin with a part of their ranges, which grows
    with every episode that succeeds.
    """
    terms, chosen = with_weights(TERMS, rewards), settings_from(AnymalSettings, settings)
    sim = simulators.load("anymal", impl=impl, substeps=SUBSTEPS, max_envs=max_envs)
    ids = look_up(sim.mj_model)
    metrics = (*METRICS, SHARE) if curriculum else METRICS
    spec = make_spec(sim.control_dt_s, term_names(terms, FLOOR), metrics)

    def begin(key: PRNGKey, share: Array | None) -> EnvState:
        key, start_key, command_key = draws.split(key, 3)
        start = sim.start(*draw_start(ids, sim.mj_model, start_key, chosen))
        command = draw_command(command_key, chosen, share)
        zero = array_module(command).zeros((), np.float32)
        task = AnymalTask(command, zero, zero, share)
        obs = observe(ids, start, task.command, constant(np.zeros(ACTION_SIZE)))
        return episode.begin(spec, start, task, obs, key)

    def reset(model: PyTree, key: PRNGKey) -> EnvState:
        return begin(key, constant(chosen.curriculum_start) if curriculum else None)

    def next_episode(model: PyTree, ended: EnvState) -> EnvState:
        return begin(ended.key, next_share(ended, chosen.curriculum_growth))

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        action = action.clip(-1.0, 1.0)
        moved, (torques, knees) = sim.step(
            model,
            state.physics,
            constant(ids.standing) + chosen.action_scale_rad * action,
            lambda data: (data.qfrc_actuator[ids.joints.qvel], data.xpos[ids.shanks]),
        )
        view = AnymalView(*errors(moved, state.task.command), torques)
        task, metrics = add_errors(state, view)
        reward = not_below_zero(total_reward(terms, view))
        obs = observe(ids, moved, task.command, action)
        down = has_fallen(moved, knees)
        return episode.advance(state, moved, task, obs, reward, down, metrics)

    env = sim.env(spec, reset, step)
    return env._replace(next_episode=next_episode) if curriculum else env


def make_spec(
    control_dt_s: float, reward_terms: tuple[str, ...], metrics: tuple[str, ...]
) -> EnvSpec:
    """What the task is, whatever moves it.

    A number that is not finite outlives the clipping of observations or shows in `qpos`, so
    `max_abs_obs` is left open.
    """
    return EnvSpec(
        name="anymal",
        obs_size=OBS_SIZE,
        action_size=ACTION_SIZE,
        control_dt_s=control_dt_s,
        episode_length=DEFAULT_EPISODE_LENGTH,
        reward_terms=reward_terms,
        metrics=metrics,
        obs_terms=OBS_TERMS,
    )


def look_up(mj_model: mujoco.MjModel) -> AnymalIds:
    """Finds the model's addresses by name, and the pose of its keyframe `stand`."""
    joints = lookup.find_joints(mj_model, JOINTS)
    return AnymalIds(
        joints,
        np.array([mj_model.body(name).id for name in SHANKS]),
        mj_model.key("stand").qpos[joints.qpos].astype(np.float32),
    )


def draw_start(
    ids: AnymalIds, mj_model: mujoco.MjModel, key: PRNGKey, settings: AnymalSettings
) -> tuple[Array, Array]:
    """Random `qpos` [19] and `qvel` [18]: the base where it starts, the legs near standing."""
    position_key, velocity_key = draws.split(key)
    shape, noise = (ACTION_SIZE,), settings.joint_velocity_noise_rad_per_s
    least, most = settings.start_factor_min, settings.start_factor_max
    factors = draws.uniform(position_key, shape, minval=least, maxval=most)
    velocities = draws.uniform(velocity_key, shape, minval=-noise, maxval=noise)
    qpos = mj_model.key("stand").qpos.astype(np.float32)
    return (
        replaced(qpos, ids.joints.qpos, factors * ids.standing),
        replaced(np.zeros(mj_model.nv, np.float32), ids.joints.qvel, velocities),
    )


def command_limits(settings: AnymalSettings) -> npt.NDArray[np.float32]:
    """The fastest command [3] forwards and to the left, m/s, and of yaw, rad/s; either way."""
    return np.array(
        (
            settings.command_forward_m_per_s,
            settings.command_left_m_per_s,
            settings.command_yaw_rad_per_s,
        ),
        np.float32,
    )


def draw_command(key: PRNGKey, settings: AnymalSettings, share: Array | None = None) -> Array:
    """Wanted speed forwards and to the left, m/s, and of yaw, rad/s [3], from a `share` of all."""
    limits = command_limits(settings)
    limits = limits if share is None else share * limits
    return draws.uniform(key, (3,), minval=-limits, maxval=limits)


def next_share(ended: EnvState, growth: float) -> Array:
    """The share [] of the commands' ranges after an episode: more if it lasted and followed."""
    succeeded = ended.truncated & (ended.metrics[METRICS[0]] <= SUCCESS_M_PER_S)
    return (ended.task.share + growth * succeeded).clip(max=1.0)


def gravity_direction(state: PhysicsState) -> Array:
    """Unit vector [3] of gravity in the base's frame, (0, 0, -1) when level.

    The figures' source turns the vector the other way round, from the base's frame to the world,
    which swaps the signs of its horizontal components, and more once the robot has yawed.
    """
    return rotations.rotate_back(state.qpos[3:7], DOWN)


def errors(state: PhysicsState, command: Array) -> tuple[Array, Array]:
    """Distances from `command` [3]: of the horizontal velocity, m/s, and of yaw's, rad/s."""
    velocity = rotations.rotate_back(state.qpos[3:7], state.qvel[:3])
    xp = array_module(velocity)
    return xp.linalg.norm(command[:2] - velocity[:2]), abs(command[2] - state.qvel[5])


def add_errors(before: EnvState, view: AnymalView) -> tuple[AnymalTask, dict[str, Array]]:
    """The task's memory after one more step, and the episode's mean errors by then."""
    task = AnymalTask(
        before.task.command,
        before.task.velocity_error_sum + view.velocity_error,
        before.task.yaw_rate_error_sum + view.yaw_rate_error,
        before.task.share,
    )
    sums = task.velocity_error_sum, task.yaw_rate_error_sum
    means = [total / (before.steps + 1) for total in sums]
    metrics = dict(zip(METRICS, means, strict=True))
    return task, metrics if task.share is None else metrics | {SHARE: task.share}


def not_below_zero(reward: tuple[Array, dict[str, Array]]) -> tuple[Array, dict[str, Array]]:
    """Lifts a negative reward to 0 by one more term, so that the terms still sum to it."""
    total, terms = reward
    lift = (-total).clip(0.0)
    return total + lift, terms | {FLOOR: lift}


def has_fallen(state: PhysicsState, knees: Array) -> Array:
    """Whether a knee or the base touches the floor, or the robot lies on its back.

    Args:
      state: the base's position is that of after the step.
      knees: [4, 3] positions in the world, metres. They are those of one physics step earlier,
        which at 1 m/s is 5 mm.
    """
    down = gravity_direction(state)
    lowest = state.qpos[2] - abs(down) @ BASE_HALF_SIZE_M
    return (knees[:, 2] < KNEE_RADIUS_M).any() | (lowest < 0.0) | (down[2] > 0.0)


def observe(ids: AnymalIds, state: PhysicsState, command: Array, action: Array) -> Array:
    """The observation [48] from the state, the command [3] and the last action [12]."""
    xp = array_module(state.qpos)
    values = xp.concatenate(
        [
            VELOCITY_SCALE * rotations.rotate_back(state.qpos[3:7], state.qvel[:3]),
            ANGULAR_VELOCITY_SCALE * state.qvel[3:6],
            gravity_direction(state),
            command * COMMAND_SCALES,
            state.qpos[ids.joints.qpos] - ids.standing,
            JOINT_VELOCITY_SCALE * state.qvel[ids.joints.qvel],
            action,
        ]
    )
    return values.clip(-OBS_LIMIT, OBS_LIMIT)
