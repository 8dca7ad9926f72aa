"""Shadow hand: turn a cube in the palm until it lies as the goal does, again and again.

Paper Table 6; figures of Isaac Gym's ShadowHand with full state (arXiv:2108.10470).
Observation [211], each value clipped to +-5, quaternions (w, x, y, z): joint positions, -1 to 1
between their limits 24; joint velocities 24; servos' torques on the joints 24; cube: position 3,
quaternion 4, velocity 3, angular velocity 3; goal: position 3, quaternion 4; rotation from goal
to cube 4; each fingertip's position, quaternion, velocity, angular velocity 5 x 13; each
fingertip's force and torque 5 x 6; last action 20.
Action [20]: position targets of the driven joints, -1 to 1 between their limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.arrays import array_module, constant, replaced
from gmijax.sim import draws, episode, rotations, simulators
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.physics_state import PhysicsState
from gmijax.sim.rewards import RewardTerm, term_names, total_reward, with_weights
from gmijax.sim.tasks import lookup
from gmijax.sim.tasks.settings import ShadowHandSettings, settings_from
from gmijax.types import Array, PRNGKey, PyTree

if TYPE_CHECKING:
    from mujoco import mjx

DEFAULT_EPISODE_LENGTH = 600
SUBSTEPS = 2
OBS_SIZE = 211
OBS_TERMS = (
    ("joint_position", 24),
    ("joint_velocity", 24),
    ("joint_torque", 24),
    ("cube_pose", 7),
    ("cube_velocity", 3),
    ("cube_angular_velocity", 3),
    ("goal_pose", 7),
    ("goal_to_cube_rotation", 4),
    ("fingertip_pose_and_velocity", 65),
    ("fingertip_force_and_torque", 30),
    ("last_action", 20),
)
ACTION_SIZE = 20
OBS_LIMIT = 5.0
VELOCITY_SCALE = 0.2
JOINT_TORQUE_SCALE = 10.0
TIP_SENSOR_SCALE = 10.0
GOAL_M = constant([0.0, -0.39, 0.56])
X_AXIS, Y_AXIS = constant([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

JOINTS = (
    *("WRJ1", "WRJ0"),
    *(f"{finger}J{i}" for finger in ("FF", "MF", "RF") for i in (3, 2, 1, 0)),
    *(f"{finger}J{i}" for finger in ("LF", "TH") for i in (4, 3, 2, 1, 0)),
)
# Numbers among the joints: J0 of a finger is not driven, it follows J1, the one before it.
FOLLOWERS = np.array([JOINTS.index(finger + "J0") for finger in ("FF", "MF", "RF", "LF")])
DRIVEN = np.setdiff1d(np.arange(len(JOINTS)), FOLLOWERS)
TIPS = ("FF", "MF", "RF", "LF", "TH")
NUM_TIPS = len(TIPS)
SENSORS = (
    *(f"{tip}_{kind}" for tip in TIPS for kind in ("velocity", "angular_velocity")),
    *(f"{tip}_{kind}" for tip in TIPS for kind in ("force", "torque")),
)


class ShadowHandTask(NamedTuple):
    """The task's memory.

    Attributes:
      goal: [4] the quaternion that the cube shall have.
      successes: [] float32, goals reached in this episode.
    """

    goal: Array
    successes: Array


@dataclass(frozen=True)
class ShadowHandIds:
    """Addresses in the model.

    Attributes:
      joints: the 24 of the hand.
      cube_qpos: where the cube's position and quaternion start in `qpos`.
      cube_qvel: where its velocities start in `qvel`.
      tip_bodies: [5] numbers of the fingers' last links.
      tip_offsets: [5, 3] where on these links the tips are, metres.
      sensors: [60] `SENSORS` in `sensordata`.
    """

    joints: lookup.Joints
    cube_qpos: int
    cube_qvel: int
    tip_bodies: lookup.Addresses
    tip_offsets: npt.NDArray[np.float32]
    sensors: lookup.Addresses


class Touch(NamedTuple):
    """What a physics step knows beside positions and velocities.

    Attributes:
      joint_torques: [24] of the servos on the joints, N m.
      tips: [5, 13] per fingertip position (m), quaternion, velocity (m/s) and angular velocity
        (rad/s), all in the world.
      tip_forces: [5, 6] N, then N m, in the tip's frame: what the last link hands on.
    """

    joint_torques: Array
    tips: Array
    tip_forces: Array


class CubePose(NamedTuple):
    """The cube in the world: m, quaternion [4], m/s, rad/s, [3] each but for the quaternion."""

    position: Array
    quat: Array
    velocity: Array
    angular_velocity: Array


class ShadowHandView(NamedTuple):
    """What the reward terms read.

    Attributes:
      distance_m: [] from the cube to the goal's position.
      error_rad: [] angle of the rotation from goal to cube, 0 to pi.
      reached: [] bool, whether that is small enough.
      action: [20].
    """

    distance_m: Array
    error_rad: Array
    reached: Array
    action: Array


TERMS = {
    "distance": RewardTerm[ShadowHandView](lambda v: v.distance_m, -10.0),
    "rotation": RewardTerm[ShadowHandView](lambda v: 1.0 / (v.error_rad + 0.1), 1.0),
    "action": RewardTerm[ShadowHandView](lambda v: (v.action**2).sum(), -0.0002),
    "success": RewardTerm[ShadowHandView](lambda v: v.reached.astype(np.float32), 250.0),
}


def make(
    *,
    impl: str = "auto",
    max_envs: int | None = None,
    rewards: Mapping[str, float] | None = None,
    settings: Mapping[str, float] | None = None,
) -> Env:
    """Makes the task without its time limit; see `gmijax.sim.registry.make_env`."""
    terms, chosen = with_weights(TERMS, rewards), settings_from(ShadowHandSettings, settings)
    sim = simulators.load("shadow_hand", impl=impl, substeps=SUBSTEPS, max_envs=max_envs)
    ids = look_up(sim.mj_model)
    spec = EnvSpec(
        name="shadow_hand",
        obs_size=OBS_SIZE,
        action_size=ACTION_SIZE,
        control_dt_s=sim.control_dt_s,
        episode_length=DEFAULT_EPISODE_LENGTH,
        reward_terms=term_names(terms),
        metrics=("successes", "rotation_error_rad"),
        obs_terms=OBS_TERMS,
    )

    def reset(model: PyTree, key: PRNGKey) -> EnvState:
        key, start_key, goal_key = draws.split(key, 3)
        qpos = draw_start(ids, sim.mj_model, start_key, chosen)
        xp = array_module(qpos)
        start = sim.start(qpos, xp.zeros(sim.mj_model.nv, np.float32))
        task = ShadowHandTask(draw_rotation(goal_key), xp.zeros((), np.float32))
        touch = touch_at_rest(ids, *sim.poses(qpos))
        obs = observe(ids, start, touch, task.goal, constant(np.zeros(ACTION_SIZE)))
        return episode.begin(spec, start, task, obs, key)

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        action = action.clip(-1.0, 1.0)
        targets = targets_of(ids, action)
        moved, touch = sim.step(model, state.physics, targets, lambda data: touch_of(ids, data))
        view = view_of(ids, moved, state.task.goal, action, chosen.reached_rad)
        reward = total_reward(terms, view)
        task, key = next_goal(state.task, view.reached, state.key)
        metrics = {"successes": task.successes, "rotation_error_rad": view.error_rad}
        obs = observe(ids, moved, touch, task.goal, action)
        fallen = view.distance_m >= chosen.fallen_m
        after = episode.advance(state, moved, task, obs, reward, fallen, metrics)
        return after._replace(key=key)

    return sim.env(spec, reset, step)


def look_up(mj_model: mujoco.MjModel) -> ShadowHandIds:
    """Finds the model's addresses by name."""
    sites = [mj_model.site(f"{tip}_tip") for tip in TIPS]
    return ShadowHandIds(
        lookup.find_joints(mj_model, JOINTS),
        *lookup.free_joint_addresses(mj_model, "cube"),
        np.array([site.bodyid[0] for site in sites]),
        np.array([site.pos for site in sites], np.float32),
        lookup.sensor_addresses(mj_model, SENSORS),
    )


def draw_rotation(key: PRNGKey) -> Array:
    """A random quaternion [4]: a turn about y, then one about x, each uniform over a circle."""
    about_x, about_y = draws.uniform(key, (2,), minval=-np.pi, maxval=np.pi)
    return rotations.product(rotations.turn(X_AXIS, about_x), rotations.turn(Y_AXIS, about_y))


def draw_start(
    ids: ShadowHandIds, mj_model: mujoco.MjModel, key: PRNGKey, settings: ShadowHandSettings
) -> Array:
    """Random `qpos` [31]: a hand nearly flat, the cube above it in any rotation."""
    joint_key, position_key, rotation_key = draws.split(key, 3)
    share, most = settings.joint_noise, settings.cube_noise_m
    lower, upper = share * ids.joints.lower, share * ids.joints.upper
    joints = draws.uniform(joint_key, lower.shape, minval=lower, maxval=upper)
    # Drawn apart from each other, two coupled joints would snap together in the first step.
    joints = replaced(joints, FOLLOWERS, joints[FOLLOWERS - 1])
    qpos = replaced(mj_model.qpos0.astype(np.float32), ids.joints.qpos, joints)
    noise = draws.uniform(position_key, (3,), minval=-most, maxval=most)
    position = qpos[ids.cube_qpos : ids.cube_qpos + 3] + noise
    cube = array_module(qpos).concatenate([position, draw_rotation(rotation_key)])
    return replaced(qpos, ids.cube_qpos, cube)


def next_goal(task: ShadowHandTask, reached: Array, key: PRNGKey) -> tuple[ShadowHandTask, Array]:
    """Another goal where the last one is reached; only then the environment's key moves on."""
    moved_on, draw = draws.split(key)
    goal = array_module(reached).where(reached, draw_rotation(draw), task.goal)
    task = ShadowHandTask(goal, task.successes + reached)
    return task, draws.next_key(reached, moved_on, key)


def targets_of(ids: ShadowHandIds, action: Array) -> Array:
    """Position targets [20], radians: the driven joints' lower limits at -1, upper at 1."""
    lower, upper = ids.joints.lower[DRIVEN], ids.joints.upper[DRIVEN]
    return 0.5 * (action + 1.0) * (upper - lower) + lower


def tips_of(ids: ShadowHandIds, xpos: Array, xquat: Array, velocities: Array) -> Array:
    """Fingertips [5, 13] from all bodies' poses [nbody, 3], [nbody, 4] and velocities [5, 6]."""
    quats = xquat[ids.tip_bodies]
    offsets = rotations.rotate(quats, constant(ids.tip_offsets))
    return array_module(quats).concatenate(
        [xpos[ids.tip_bodies] + offsets, quats, velocities], axis=1
    )


def touch_at_rest(ids: ShadowHandIds, xpos: Array, xquat: Array) -> Touch:
    """A start: nothing moves, and the servos' targets are where the joints are.

    The tips' sensors read zero: a reset runs no physics, see `Physics.start`.
    """
    zeros = constant(np.zeros((NUM_TIPS, 6)))
    return Touch(constant(np.zeros(len(JOINTS))), tips_of(ids, xpos, xquat, zeros), zeros)


def touch_of(ids: ShadowHandIds, data: mjx.Data) -> Touch:
    """What a physics step left in its data."""
    velocities, forces = data.sensordata[ids.sensors].reshape(2, NUM_TIPS, 6)
    torques = data.qfrc_actuator[ids.joints.qvel]
    return Touch(torques, tips_of(ids, data.xpos, data.xquat, velocities), forces)


def cube_of(ids: ShadowHandIds, state: PhysicsState) -> CubePose:
    """The cube's pose and velocities, all seen from the world."""
    pose = state.qpos[ids.cube_qpos : ids.cube_qpos + 7]
    velocity = state.qvel[ids.cube_qvel : ids.cube_qvel + 6]
    # MuJoCo has the angular velocity of a free body in the body's own frame.
    return CubePose(pose[:3], pose[3:], velocity[:3], rotations.rotate(pose[3:], velocity[3:]))


def view_of(
    ids: ShadowHandIds,
    state: PhysicsState,
    goal: Array,
    action: Array,
    reached_rad: float,
) -> ShadowHandView:
    """What the reward of a step reads, with the goal [4] that the step was to reach."""
    cube = cube_of(ids, state)
    error = rotations.angle(rotations.product(cube.quat, rotations.conjugate(goal)))
    distance = array_module(goal, cube.position).linalg.norm(cube.position - GOAL_M)
    return ShadowHandView(distance, error, error <= reached_rad, action)


def observe(
    ids: ShadowHandIds, state: PhysicsState, touch: Touch, goal: Array, action: Array
) -> Array:
    """The observation [211] from the state, the goal [4] and the last action [20]."""
    joints, cube = state.qpos[ids.joints.qpos], cube_of(ids, state)
    to_cube = rotations.product(cube.quat, rotations.conjugate(goal))
    xp = array_module(joints)
    values = xp.concatenate(
        [
            ids.joints.scaled(joints),
            VELOCITY_SCALE * state.qvel[ids.joints.qvel],
            JOINT_TORQUE_SCALE * touch.joint_torques,
            *(cube.position, cube.quat, cube.velocity, VELOCITY_SCALE * cube.angular_velocity),
            *(GOAL_M, goal, to_cube),
            touch.tips.ravel(),
            TIP_SENSOR_SCALE * touch.tip_forces.ravel(),
            action,
        ]
    )
    return values.clip(-OBS_LIMIT, OBS_LIMIT)
