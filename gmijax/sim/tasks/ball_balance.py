"""Ball balance: catch a falling ball with a tray on three legs and hold it in the middle.

Paper Table 6; figures of Isaac Gym's BallBalance (arXiv:2108.10470).
Observation [24], each value clipped to +-5: knee positions 3 and velocities 3; ball position 3
and velocity 3; at the three hips the upward force 3 and the torque 9.
Action [3]: speed of the knees' position targets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from gmijax.arrays import array_module, constant, replaced
from gmijax.sim import draws, episode, simulators
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.physics_state import PhysicsState
from gmijax.sim.rewards import RewardTerm, term_names, total_reward, with_weights
from gmijax.sim.tasks import lookup
from gmijax.sim.tasks.settings import BallBalanceSettings, settings_from
from gmijax.types import Array, PRNGKey, PyTree

DEFAULT_EPISODE_LENGTH = 500
SUBSTEPS = 2
# A ball in play stays below 50, the impact of its fall included.
MAX_ABS_OBS = 500.0
OBS_SIZE = 24
OBS_TERMS = (
    ("knee_position", 3),
    ("knee_velocity", 3),
    ("ball_position", 3),
    ("ball_velocity", 3),
    ("hip_force_z", 3),
    ("hip_torque", 9),
)
ACTION_SIZE = 3
OBS_LIMIT = 5.0
SENSOR_SCALE = 0.05
START_DISTANCE_MIN_M = 0.001

LEGS = (1, 2, 3)
KNEES = tuple(f"knee_{leg}" for leg in LEGS)


class BallBalanceTask(NamedTuple):
    """The task's memory.

    Attributes:
      targets: [3] position targets of the knees, radians.
    """

    targets: Array


@dataclass(frozen=True)
class BallBalanceIds:
    """Addresses in the model.

    Attributes:
      knees: the 3 driven joints.
      ball_qpos: where the ball's position starts in `qpos`.
      ball_qvel: where the ball's velocity starts in `qvel`.
      sensors: [12] three upward forces, then three torques, in `sensordata`.
    """

    knees: lookup.Joints
    ball_qpos: int
    ball_qvel: int
    sensors: lookup.Addresses


class BallBalanceView(NamedTuple):
    """What the reward reads: positions [3] in metres, of the ball and the goal, and m/s [3]."""

    ball: Array
    ball_velocity: Array
    goal: Array


def balance(view: BallBalanceView) -> Array:
    """1 for a ball at rest in the goal, less with distance and with speed."""
    norm = array_module(view.ball).linalg.norm
    return 1.0 / (1.0 + norm(view.ball - view.goal)) / (1.0 + norm(view.ball_velocity))


TERMS = {"balance": RewardTerm[BallBalanceView](balance, 1.0)}


def make(
    *,
    impl: str = "auto",
    max_envs: int | None = None,
    rewards: Mapping[str, float] | None = None,
    settings: Mapping[str, float] | None = None,
) -> Env:
    """Makes the task without its time limit; see `gmijax.sim.registry.make_env`."""
    terms, chosen = with_weights(TERMS, rewards), settings_from(BallBalanceSettings, settings)
    sim = simulators.load("ball_balance", impl=impl, substeps=SUBSTEPS, max_envs=max_envs)
    ids = look_up(sim.mj_model)
    spec = EnvSpec(
        name="ball_balance",
        obs_size=OBS_SIZE,
        action_size=ACTION_SIZE,
        control_dt_s=sim.control_dt_s,
        episode_length=DEFAULT_EPISODE_LENGTH,
        reward_terms=term_names(terms),
        max_abs_obs=MAX_ABS_OBS,
        obs_terms=OBS_TERMS,
    )

    def reset(model: PyTree, key: PRNGKey) -> EnvState:
        key, draw = draws.split(key)
        start = sim.start(*draw_start(ids, sim.mj_model, draw, chosen))
        # Sensors read zero: a reset runs no physics, see `Physics.start`.
        obs = observe(ids, start, constant(np.zeros(len(ids.sensors))))
        targets = array_module(obs).zeros(ACTION_SIZE, np.float32)
        return episode.begin(spec, start, BallBalanceTask(targets), obs, key)

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        change = chosen.action_speed_rad_per_s * sim.control_dt_s * action.clip(-1.0, 1.0)
        targets = (state.task.targets + change).clip(ids.knees.lower, ids.knees.upper)
        moved, sensordata = sim.step(model, state.physics, targets)
        ball, ball_velocity = ball_of(ids, moved)
        goal = constant((0.0, 0.0, chosen.goal_height_m))
        reward = total_reward(terms, BallBalanceView(ball, ball_velocity, goal))
        obs = observe(ids, moved, sensordata[ids.sensors])
        fallen = ball[2] < chosen.fallen_height_m
        return episode.advance(state, moved, BallBalanceTask(targets), obs, reward, fallen)

    return sim.env(spec, reset, step)


def look_up(mj_model: mujoco.MjModel) -> BallBalanceIds:
    """Finds the model's addresses by name."""
    forces = lookup.sensor_addresses(mj_model, [f"hip_{leg}_force" for leg in LEGS])
    torques = lookup.sensor_addresses(mj_model, [f"hip_{leg}_torque" for leg in LEGS])
    return BallBalanceIds(
        lookup.find_joints(mj_model, KNEES),
        *lookup.free_joint_addresses(mj_model, "ball"),
        # Of each force only z, along which the leg carries: the load on three legs shows where
        # the ball is and how hard it lands. The task's size is that of three forces.
        np.concatenate([forces[2::3], torques]),
    )


def draw_start(
    ids: BallBalanceIds, mj_model: mujoco.MjModel, key: PRNGKey, settings: BallBalanceSettings
) -> tuple[Array, Array]:
    """Random `qpos` [20] and `qvel` [18]: the tray at rest, the ball above it, falling inwards."""
    direction_key, distance_key, height_key, speed_key = draws.split(key, 4)
    direction = draws.uniform(direction_key, maxval=2.0 * np.pi)
    xp = array_module(direction)
    outwards = xp.stack([xp.cos(direction), xp.sin(direction)])
    nearest, farthest = START_DISTANCE_MIN_M, settings.start_distance_max_m
    distance = draws.uniform(distance_key, minval=nearest, maxval=farthest)
    lowest, highest = settings.start_height_min_m, settings.start_height_max_m
    height = draws.uniform(height_key, minval=lowest, maxval=highest)
    # The farther out, the faster inwards, so that a ball crosses the tray but seldom misses it.
    speed = draws.uniform(speed_key, maxval=settings.start_speed_m_per_s)
    speed = speed * (distance - nearest) / (farthest - nearest)
    ball = xp.append(distance * outwards, height)
    velocity = xp.append(-speed * outwards, -settings.start_speed_m_per_s)
    return (
        replaced(mj_model.qpos0.astype(np.float32), ids.ball_qpos, ball),
        replaced(np.zeros(mj_model.nv, np.float32), ids.ball_qvel, velocity),
    )


def ball_of(ids: BallBalanceIds, state: PhysicsState) -> tuple[Array, Array]:
    """The ball's position [3] in metres and velocity [3] in m/s, in the world."""
    return (
        state.qpos[ids.ball_qpos : ids.ball_qpos + 3],
        state.qvel[ids.ball_qvel : ids.ball_qvel + 3],
    )


def observe(ids: BallBalanceIds, state: PhysicsState, hip_sensors: Array) -> Array:
    """The observation [24] from the state and raw hip sensors [12]."""
    xp = array_module(state.qpos)
    values = xp.concatenate(
        [
            state.qpos[ids.knees.qpos],
            state.qvel[ids.knees.qvel],
            *ball_of(ids, state),
            SENSOR_SCALE * hip_sensors,
        ]
    )
    return values.clip(-OBS_LIMIT, OBS_LIMIT)
