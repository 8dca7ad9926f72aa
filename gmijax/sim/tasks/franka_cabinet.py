"""Franka cabinet: open a drawer with an arm and a two-finger gripper.

Paper Table 6; figures of Isaac Gym's FrankaCabinet (arXiv:2108.10470).
Observation [23], each value clipped to +-5: joint positions, -1 to 1 between their limits 9;
joint velocities 9; way from the gripper to the handle 3; opening of the drawer 1; its speed 1.
Action [9]: speed of the position targets of arm 7 and fingers 2.
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
from gmijax.sim.rewards import Replacement, RewardTerm, term_names, total_reward, with_weights
from gmijax.sim.tasks import lookup
from gmijax.sim.tasks.settings import FrankaCabinetSettings, settings_from
from gmijax.types import Array, PRNGKey, PyTree

DEFAULT_EPISODE_LENGTH = 500
SUBSTEPS = 2
OBS_SIZE = 23
OBS_TERMS = (
    ("joint_position", 9),
    ("joint_velocity", 9),
    ("gripper_to_handle", 3),
    ("drawer_position", 1),
    ("drawer_velocity", 1),
)
ACTION_SIZE = 9
OBS_LIMIT = 5.0
JOINT_VELOCITY_SCALE = 0.1
# Between the fingers' pads. The figures' source has a point where the fingers begin, and 0.04 m
# askew from there; a gripper that holds the handle is 0.06 m away from it.
GRASP_IN_HAND_M = constant([0.0, 0.0, 0.0584 + 0.045])
# In a finger's frame: the inner face of its pad, near the tip. The source takes the root.
PAD_IN_FINGER_M = constant([0.0, 0.0, 0.045])
HANDLE_IN_DRAWER_M = constant([0.3, 0.01, 0.0])
Y_AXIS, Z_AXIS = constant([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
NEAR_M = 0.02
FINGER_REACH_M = 0.04
BEHIND_M = 0.04

JOINTS = (*(f"joint_{i}" for i in range(1, 8)), "finger_left", "finger_right")


class FrankaCabinetTask(NamedTuple):
    """The task's memory.

    Attributes:
      targets: [9] position targets of arm and fingers, radians and metres.
    """

    targets: Array


@dataclass(frozen=True)
class FrankaCabinetIds:
    """Addresses in the model.

    Attributes:
      joints: the 9 driven ones.
      drawer_joint: the one along which the drawer opens.
      hand: the hand's number among the bodies.
      fingers: [2] numbers of the left and the right finger.
      drawer: number of the drawer.
    """

    joints: lookup.Joints
    drawer_joint: lookup.Joints
    hand: int
    fingers: lookup.Addresses
    drawer: int


class FrankaCabinetPose(NamedTuple):
    """Where gripper and handle are, in the world.

    Attributes:
      grasp: [3] the gripper's point that is to reach the handle, metres.
      handle: [3] the handle's point, metres.
      forward: [3] unit vector along which the fingers point.
      up: [3] unit vector from the right finger to the left one.
      fingers: [2, 3] inner faces of the left and the right finger's pad, metres.
    """

    grasp: Array
    handle: Array
    forward: Array
    up: Array
    fingers: Array


class FrankaCabinetView(NamedTuple):
    """What the reward terms read.

    Attributes:
      pose: of gripper and handle.
      drawer_m: [] the drawer's opening, metres.
      action: [9] clipped.
      open_m: from which opening on the drawer counts as open.
      distance_scale_m: see the settings.
    """

    pose: FrankaCabinetPose
    drawer_m: Array
    action: Array
    open_m: float
    distance_scale_m: float


def closeness(view: FrankaCabinetView) -> Array:
    """1 where the gripper is at the handle, less with distance; doubled when near."""
    way = view.pose.handle - view.pose.grasp
    squared = way @ way
    shape = (1.0 + squared / view.distance_scale_m**2) ** -2
    return shape * array_module(squared).where(squared <= NEAR_M**2, 2.0, 1.0)


def alignment(view: FrankaCabinetView) -> Array:
    """1 for a gripper that points into the cabinet with one finger above the other, else less."""
    inward, up = -view.pose.forward[0], view.pose.up[2]
    return 0.5 * (inward * abs(inward) + up * abs(up))


def finger_heights(view: FrankaCabinetView) -> Array:
    """Heights [2] of the fingers above the handle, metres."""
    return view.pose.fingers[:, 2] - view.pose.handle[2]


def around(view: FrankaCabinetView) -> Array:
    """0.5 with the left finger above the handle and the right one below it, else 0."""
    left, right = finger_heights(view)
    return 0.5 * ((left > 0.0) & (right < 0.0))


def pinch(view: FrankaCabinetView) -> Array:
    """Metres by which fingers around the handle are nearer to its height than fully open."""
    reach = (FINGER_REACH_M - abs(finger_heights(view))).sum()
    return array_module(reach).where(around(view) > 0.0, reach, 0.0)


def beyond(opening_m: float, view: FrankaCabinetView) -> Array:
    """1 when the drawer is open by more than `opening_m`, else 0."""
    return (view.drawer_m > opening_m).astype(np.float32)


TERMS = {
    "distance": RewardTerm[FrankaCabinetView](closeness, 2.0),
    "alignment": RewardTerm[FrankaCabinetView](alignment, 0.5),
    "around": RewardTerm[FrankaCabinetView](around, 0.25),
    "pinch": RewardTerm[FrankaCabinetView](pinch, 5.0),
    "opening": RewardTerm[FrankaCabinetView](lambda v: v.drawer_m * (1.0 + around(v)), 7.5),
    "action": RewardTerm[FrankaCabinetView](lambda v: (v.action**2).sum(), -0.01),
    "ajar": RewardTerm[FrankaCabinetView](lambda v: beyond(0.01, v), 0.5),
    "half_open": RewardTerm[FrankaCabinetView](lambda v: beyond(0.2, v) * around(v), 1.0),
    "open": RewardTerm[FrankaCabinetView](lambda v: beyond(v.open_m, v) * around(v), 2.0),
}
BEHIND = "behind"


def make(
    *,
    impl: str = "auto",
    max_envs: int | None = None,
    rewards: Mapping[str, float] | None = None,
    settings: Mapping[str, float] | None = None,
) -> Env:
    """Makes the task without its time limit; see `gmijax.sim.registry.make_env`."""
    terms, chosen = with_weights(TERMS, rewards), settings_from(FrankaCabinetSettings, settings)
    sim = simulators.load("franka_cabinet", impl=impl, substeps=SUBSTEPS, max_envs=max_envs)
    ids, speeds = look_up(sim.mj_model), action_speeds(chosen)
    spec = EnvSpec(
        name="franka_cabinet",
        obs_size=OBS_SIZE,
        action_size=ACTION_SIZE,
        control_dt_s=sim.control_dt_s,
        episode_length=DEFAULT_EPISODE_LENGTH,
        reward_terms=term_names(terms, BEHIND),
        metrics=("drawer_m", "opened"),
        obs_terms=OBS_TERMS,
    )

    def reset(model: PyTree, key: PRNGKey) -> EnvState:
        key, draw = draws.split(key)
        qpos = draw_start(ids, sim.mj_model, draw, chosen)
        start = sim.start(qpos, array_module(qpos).zeros(sim.mj_model.nv, np.float32))
        obs = observe(ids, start, pose_of(ids, *sim.poses(start.qpos)))
        task = FrankaCabinetTask(start.qpos[ids.joints.qpos])
        return episode.begin(spec, start, task, obs, key)

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        action = action.clip(-1.0, 1.0)
        change = speeds * sim.control_dt_s * action
        targets = (state.task.targets + change).clip(ids.joints.lower, ids.joints.upper)
        moved, poses = sim.step(
            model, state.physics, targets, lambda data: (data.xpos, data.xquat)
        )
        pose, drawer_m = pose_of(ids, *poses), moved.qpos[ids.drawer_joint.qpos[0]]
        opened = drawer_m > chosen.open_m
        reward = total_reward(
            terms,
            FrankaCabinetView(pose, drawer_m, action, chosen.open_m, chosen.distance_scale_m),
            Replacement(BEHIND, is_behind(pose), chosen.behind_reward, chosen.behind_keeps),
        )
        metrics = {"drawer_m": drawer_m, "opened": opened.astype(np.float32)}
        task, obs = FrankaCabinetTask(targets), observe(ids, moved, pose)
        terminated, truncated = ends(opened, chosen)
        return episode.advance(state, moved, task, obs, reward, terminated, metrics, truncated)

    return sim.env(spec, reset, step)


def ends(opened: Array, settings: FrankaCabinetSettings) -> tuple[Array, Array]:
    """Whether an open drawer [] terminates the episode, and whether it truncates it.

    Nothing is lost by a truncation: a termination costs all that could still be earned, unless
    the term `open` pays for it, and policies learn to stop just short of it.
    """
    never = array_module(opened).zeros((), bool)
    return (opened, never) if settings.open_terminates else (never, opened)


def look_up(mj_model: mujoco.MjModel) -> FrankaCabinetIds:
    """Finds the model's addresses by name."""
    return FrankaCabinetIds(
        lookup.find_joints(mj_model, JOINTS),
        lookup.find_joints(mj_model, ["drawer"]),
        mj_model.body("hand").id,
        np.array([mj_model.body(f"finger_{side}").id for side in ("left", "right")]),
        mj_model.body("drawer").id,
    )


def action_speeds(settings: FrankaCabinetSettings) -> npt.NDArray[np.float32]:
    """Of the targets at full action [9]: rad/s of the arm's, m/s of the fingers'."""
    arm, finger = settings.arm_speed_rad_per_s, settings.finger_speed_m_per_s
    return np.array([arm] * 7 + [finger] * 2, np.float32)


def draw_start(
    ids: FrankaCabinetIds, mj_model: mujoco.MjModel, key: PRNGKey, settings: FrankaCabinetSettings
) -> Array:
    """Random `qpos` [10]: noise on arm and fingers, the drawer closed."""
    start = np.asarray(mj_model.key("start").qpos, np.float32)
    # The fingers' too: by 0.125 m, so that most start wide open or closed.
    most = settings.joint_noise
    noise = draws.uniform(key, (ACTION_SIZE,), minval=-most, maxval=most)
    joints = (start[ids.joints.qpos] + noise).clip(ids.joints.lower, ids.joints.upper)
    return replaced(start, ids.joints.qpos, joints)


def pose_of(ids: FrankaCabinetIds, xpos: Array, xquat: Array) -> FrankaCabinetPose:
    """Gripper and handle from all bodies' positions [nbody, 3] and quaternions [nbody, 4]."""
    hand = xquat[ids.hand]
    handle = rotations.rotate(xquat[ids.drawer], HANDLE_IN_DRAWER_M)
    return FrankaCabinetPose(
        grasp=xpos[ids.hand] + rotations.rotate(hand, GRASP_IN_HAND_M),
        handle=xpos[ids.drawer] + handle,
        forward=rotations.rotate(hand, Z_AXIS),
        up=rotations.rotate(hand, Y_AXIS),
        fingers=xpos[ids.fingers] + rotations.rotate(hand, PAD_IN_FINGER_M),
    )


def is_behind(pose: FrankaCabinetPose) -> Array:
    """Whether a finger went through the drawer's front instead of taking the handle."""
    return (pose.fingers[:, 0] < pose.handle[0] - BEHIND_M).any()


def observe(ids: FrankaCabinetIds, state: PhysicsState, pose: FrankaCabinetPose) -> Array:
    """The observation [23] from the state and the poses."""
    xp = array_module(state.qpos)
    values = xp.concatenate(
        [
            ids.joints.scaled(state.qpos[ids.joints.qpos]),
            JOINT_VELOCITY_SCALE * state.qvel[ids.joints.qvel],
            pose.handle - pose.grasp,
            state.qpos[ids.drawer_joint.qpos],
            state.qvel[ids.drawer_joint.qvel],
        ]
    )
    return values.clip(-OBS_LIMIT, OBS_LIMIT)
