from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from gmijax.errors import ConfigError
from gmijax.sim import physics, simulators
from gmijax.sim.tasks import franka_cabinet as task
from gmijax.sim.tasks.settings import FrankaCabinetSettings

SETTINGS = FrankaCabinetSettings()
CENTRE_OF_HANDLE_M = np.array([0.344, 0.0, 0.7262])
# Columns are the hand's axes: fingers point into the cabinet, one above the other.
HAND_AT_HANDLE = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def sim() -> physics.Physics:
    return simulators.load("franka_cabinet", impl="jax", substeps=task.SUBSTEPS)


def pose(
    grasp: Sequence[float] = (0.0, 0.0, 0.5),
    handle: Sequence[float] = (0.0, 0.0, 0.5),
    heights: Sequence[float] = (0.03, -0.01),
    forward: Sequence[float] = (-1.0, 0.0, 0.0),
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> task.FrankaCabinetPose:
    """A gripper that points into the cabinet, fingers at `heights` above the handle, metres."""
    fingers = [[handle[0], 0.0, handle[2] + height] for height in heights]
    return task.FrankaCabinetPose(*map(jnp.array, (grasp, handle, forward, up, fingers)))


def view(
    pose: task.FrankaCabinetPose, drawer_m: float = 0.0, scale_m: float = 1.0
) -> task.FrankaCabinetView:
    action = jnp.zeros(task.ACTION_SIZE)
    return task.FrankaCabinetView(pose, jnp.array(drawer_m), action, SETTINGS.open_m, scale_m)


BOTH_ABOVE, SWAPPED = {"heights": (0.03, 0.01)}, {"heights": (-0.01, 0.03)}


@pytest.mark.parametrize(
    ("term", "posed", "seen", "expected"),
    [
        # Doubled within two centimetres, and a quarter at its scale.
        ("distance", {"handle": (0.5, 0.0, 0.5)}, {}, 2.0 / 1.25**2),
        ("distance", {"handle": (0.021, 0.0, 0.5)}, {}, 2.0 / 1.000441**2),
        ("distance", {"handle": (0.019, 0.0, 0.5)}, {}, 4.0 / 1.000361**2),
        ("distance", {"handle": (0.2, 0.0, 0.5)}, {"scale_m": 0.2}, 2.0 / 4.0),
        ("distance", {"handle": (0.01, 0.0, 0.5)}, {"scale_m": 0.2}, 4.0 / 1.0025**2),
        # Each axis keeps its sign.
        ("alignment", {}, {}, 0.5),
        ("alignment", {"forward": (-(0.5**0.5), 0.0, -(0.5**0.5))}, {}, 0.25 * (0.5 + 1.0)),
        ("alignment", {"up": (0.0, 0.0, -1.0)}, {}, 0.0),
        # Fingers on both sides of the handle, the left one above it.
        ("around", {}, {}, 0.25 * 0.5),
        ("around", BOTH_ABOVE, {}, 0.0),
        ("around", SWAPPED, {}, 0.0),
        ("pinch", {}, {}, 5.0 * (0.01 + 0.03)),
        ("pinch", BOTH_ABOVE, {}, 0.0),
        ("pinch", SWAPPED, {}, 0.0),
        # An open drawer pays more with the fingers around the handle.
        ("opening", {}, {"drawer_m": 0.3}, 7.5 * 0.3 * 1.5),
        ("opening", BOTH_ABOVE, {"drawer_m": 0.3}, 7.5 * 0.3),
        ("ajar", {}, {"drawer_m": 0.0}, 0.0),
        ("ajar", BOTH_ABOVE, {"drawer_m": 0.1}, 0.5),
        ("half_open", {}, {"drawer_m": 0.1}, 0.0),
        ("half_open", {}, {"drawer_m": 0.3}, 0.5),
        ("half_open", BOTH_ABOVE, {"drawer_m": 0.3}, 0.0),
        ("open", {}, {"drawer_m": 0.3}, 0.0),
        ("open", {}, {"drawer_m": 0.395}, 1.0),
    ],
)
def test_terms_of_the_reward_by_hand(term: str, posed: Any, seen: Any, expected: float):
    of = task.TERMS[term]
    assert float(of.weight * of.fn(view(pose(**posed), **seen))) == pytest.approx(expected)


@pytest.mark.parametrize("opened", [False, True])
def test_an_open_drawer_truncates_unless_it_shall_terminate(opened: bool):
    for terminates, expected in ((0.0, (False, opened)), (1.0, (opened, False))):
        settings = FrankaCabinetSettings(open_terminates=terminates)
        found = task.ends(jnp.array(opened), settings)
        assert tuple(bool(end) for end in found) == expected


def test_whether_an_open_drawer_terminates_is_no_share():
    with pytest.raises(ConfigError, match=r"env.settings.open_terminates=0.5: must be 0 or 1"):
        FrankaCabinetSettings(open_terminates=0.5)


def test_a_finger_behind_the_handle_differs_from_one_at_it():
    at_handle = pose()
    for finger in (0, 1):
        for depth_m, behind in ((0.039, False), (0.041, True)):
            moved = at_handle.fingers.at[finger, 0].add(-depth_m)
            assert bool(task.is_behind(at_handle._replace(fingers=moved))) is behind


def test_pose_is_that_of_the_model_in_c(sim: physics.Physics):
    model = sim.mj_model
    ids, data, rng = task.look_up(model), mujoco.MjData(model), np.random.default_rng(0)
    limits = model.jnt_range
    for _ in range(3):
        data.qpos = rng.uniform(limits[:, 0], limits[:, 1])
        mujoco.mj_kinematics(model, data)
        derived = task.pose_of(ids, jnp.array(data.xpos), jnp.array(data.xquat))
        link_7, hand = data.body("link_7"), data.body("hand").xmat.reshape(3, 3)
        roots = np.stack([data.body(f"finger_{side}").xpos for side in ("left", "right")])
        fingers = roots + 0.045 * hand[:, 2]
        # Fully closed, both pads are on the hand's axis.
        grasp = link_7.xpos + link_7.xmat.reshape(3, 3) @ [0.0, 0.0, 0.1654 + 0.045]
        np.testing.assert_allclose(derived.grasp, grasp, atol=1e-5)
        np.testing.assert_allclose(derived.forward, hand[:, 2], atol=1e-5)
        np.testing.assert_allclose(derived.up, hand[:, 1], atol=1e-5)
        np.testing.assert_allclose(derived.fingers, fingers, atol=1e-5)
        handle = [0.0515 + 0.3 + data.joint("drawer").qpos[0], 0.01, 0.4 + 0.3172]
        np.testing.assert_allclose(derived.handle, handle, atol=1e-5)


def test_observation_scales_joints_and_is_clipped(sim: physics.Physics):
    ids = task.look_up(sim.mj_model)
    qpos = np.append(ids.joints.upper, 0.25).astype(np.float32)
    qvel = np.array([100.0, -100.0, 2.0, *[0.0] * 6, 0.5], np.float32)
    state = physics.PhysicsState(jnp.array(qpos), jnp.array(qvel), jnp.zeros(10))
    obs = task.observe(ids, state, pose(grasp=(0.0, 0.1, 0.2), handle=(0.3, 0.0, 0.5)))
    np.testing.assert_allclose(obs[:9], 1.0, atol=1e-6)
    np.testing.assert_allclose(obs[9:12], [5.0, -5.0, 0.2], atol=1e-6)
    np.testing.assert_allclose(obs[18:], [0.3, -0.1, 0.3, 0.25, 0.5], atol=1e-6)


def test_start_is_noisy_within_the_limits_and_the_drawer_is_closed(sim: physics.Physics):
    model = sim.mj_model
    ids = task.look_up(model)
    qpos = jax.vmap(lambda key: task.draw_start(ids, model, key, SETTINGS))(
        jax.random.split(jax.random.key(0), 64)
    )
    joints, rest = qpos[:, ids.joints.qpos], model.key("start").qpos[ids.joints.qpos]
    assert (joints >= ids.joints.lower).all()
    assert (joints <= ids.joints.upper).all()
    assert float(jnp.abs(joints - rest).max()) <= SETTINGS.joint_noise + 1e-6
    assert float(joints[:, :7].std(axis=0).min()) > 0.05
    assert (qpos[:, ids.drawer_joint.qpos] == 0.0).all()


def solve_arm(model: mujoco.MjModel, qpos: npt.NDArray[np.float64], hand_m: list[float]) -> None:
    """Moves the arm in `qpos` [10] towards a hand at `hand_m` [3], level before the handle."""
    data = mujoco.MjData(model)
    hand, jacobian = model.body("hand").id, np.zeros((2, 3, model.nv))
    for _ in range(10):
        data.qpos = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacBody(model, data, jacobian[0], jacobian[1], hand)
        axes = data.xmat[hand].reshape(3, 3)
        turn = np.cross(axes, HAND_AT_HANDLE, axis=0).sum(axis=1) / 2
        error = np.concatenate([hand_m - data.xpos[hand], turn])
        arm = jacobian.reshape(6, -1)[:, :7]
        qpos[:7] += arm.T @ np.linalg.solve(arm @ arm.T + 1e-3 * np.eye(6), error)
        qpos[:7] = np.clip(qpos[:7], model.jnt_range[:7, 0], model.jnt_range[:7, 1])


def wanted_positions(model: mujoco.MjModel) -> npt.NDArray[np.float64]:
    """Positions [L, 9] of arm and fingers that reach for the handle, pinch it, and pull."""
    x, y, z = CENTRE_OF_HANDLE_M
    reach, approach = [x + 0.2] * 70, list(np.linspace(x + 0.2, x + 0.1, 20)) + [x + 0.1] * 20
    pull = list(np.linspace(x + 0.1, x + 0.54, 60)) + [x + 0.54] * 30
    qpos, wanted = model.key("start").qpos.copy(), []
    for hand_x, grip_m in [
        *((hand_x, 0.04) for hand_x in reach + approach),
        *((x + 0.1, 0.0) for _ in range(25)),
        *((hand_x, 0.0) for hand_x in pull),
    ]:
        solve_arm(model, qpos, [hand_x, y, z])
        wanted.append([*qpos[:7], grip_m, grip_m])
    return np.array(wanted)


def test_the_drawer_can_be_opened_by_the_handle(sim: physics.Physics):
    # In C, by actions within [-1, 1]: each moves the targets by at most one step's worth.
    model, limits = sim.mj_model, sim.mj_model.jnt_range[:9]
    data, ids = mujoco.MjData(model), task.look_up(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    targets, step = data.ctrl.copy(), task.action_speeds(SETTINGS) * sim.control_dt_s
    for wanted in wanted_positions(model):
        targets += step * np.clip((wanted - targets) / step, -1.0, 1.0)
        data.ctrl = np.clip(targets, limits[:, 0], limits[:, 1])
        mujoco.mj_step(model, data, sim.substeps)
        seen = task.pose_of(ids, jnp.array(data.xpos), jnp.array(data.xquat))
        assert not task.is_behind(seen)
        if data.joint("drawer").qpos[0] > SETTINGS.open_m:
            break
    assert data.joint("drawer").qpos[0] > SETTINGS.open_m
    # The fingers hold the handle: it was pulled, not pushed along.
    assert task.around(view(seen)) == 0.5
    assert data.ncon >= 2
