"""What a film shows: the robot stays in the picture, with its command above it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from gmijax.sim.camera import choose_camera, free_robot
from gmijax.sim.registry import TASKS, make_env
from gmijax.sim.stage import put, show_command

FREE = '<body name="{0}"><freejoint/><geom size=".3"/>{1}</body>'
LEG = '<body name="leg"><joint name="hip"/><geom size=".1" pos="1 0 0"/>{0}</body>'
HIP = '<actuator><motor joint="hip"/></actuator>'
ROBOT = FREE.format("robot", LEG.format(""))
HEAD = '<camera name="eye"/>'


def _model(world: str, rest: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{world}</worldbody>{rest}</mujoco>")


STILL = '<camera name="still"/><body><geom size="1"/></body>'
BEHIND = '<camera name="behind" mode="trackcom"/>'


@pytest.mark.parametrize(
    ("world", "wanted", "index", "name"),
    [
        (STILL, None, 0, "camera still"),
        (STILL + BEHIND, None, 1, "camera behind"),
        (STILL + BEHIND + '<camera name="track"/>', None, 2, "camera track"),
        (STILL + BEHIND, "still", 0, "camera still"),
        (FREE.format("robot", BEHIND), None, 0, "camera behind"),
        ('<camera mode="track"/>', None, 0, "camera 0"),
        # On an arm: one that stands still, also if it comes behind that of the hand.
        (LEG.format(HEAD) + STILL, None, 0, "camera still"),
        (LEG.format(HEAD) + f'<body pos="0 0 1">{STILL}</body>', None, 1, "camera still"),
        (LEG.format(HEAD), None, -1, "MuJoCo's free view"),
        (LEG.format(HEAD), "eye", 0, "camera eye"),
        ("", None, -1, "MuJoCo's free view"),
    ],
)
def test_a_camera_of_the_model(world: str, wanted: str | None, index: int, name: str):
    assert choose_camera(_model(world), wanted) == (index, name)


@pytest.mark.parametrize("camera", ["", HEAD])
@pytest.mark.parametrize("other", ["", STILL])
def test_a_robot_that_moves_freely_is_followed(camera: str, other: str):
    robot = FREE.format("robot", LEG.format("") + camera)
    chosen = choose_camera(_model(other + robot, HIP), None)
    assert chosen.name == "a view that follows robot"
    assert chosen.view.type == mujoco.mjtCamera.mjCAMERA_TRACKING


CUBE = FREE.format("cube", "")
SPATIAL = (
    '<tendon><spatial name="t"><site site="a"/><site site="b"/></spatial></tendon>'
    '<actuator><motor tendon="t"/></actuator>'
)


@pytest.mark.parametrize(
    ("world", "rest", "followed"),
    [
        (CUBE + ROBOT, HIP, "robot"),
        (CUBE, "", "cube"),
        (CUBE + LEG.format(""), HIP, None),  # An arm and a cube.
        (
            FREE.format("robot", '<site name="a"/>' + LEG.format('<site name="b"/>')) + CUBE,
            SPATIAL,
            "robot",
        ),
        (
            FREE.format("drone", '<site name="a"/>') + CUBE,
            '<actuator><motor site="a"/></actuator>',
            "drone",
        ),
    ],
)
def test_what_is_free_and_has_motors_is_the_robot(world: str, rest: str, followed: str | None):
    model = _model(world, rest)
    found = free_robot(model)
    assert (None if found is None else model.body(found).name) == followed


def test_a_robot_stays_in_the_middle_and_large_on_any_ground():
    ground = '<geom type="box" size="500 500 .1" pos="0 0 -5"/>'
    model = _model(ground + ROBOT, HIP)
    data = mujoco.MjData(model)
    data.qpos[:2] = 40.0, -7.0
    mujoco.mj_forward(model, data)
    view = choose_camera(model, None).view
    scene = mujoco.MjvScene(model, 100)
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL, scene
    )
    camera = scene.camera[0]
    to_robot = data.subtree_com[model.body("robot").id] - camera.pos
    distance = np.linalg.norm(to_robot)
    np.testing.assert_allclose(to_robot / distance, camera.forward, atol=0.02)
    assert 2.0 < distance < 6.0  # It reaches 1.1 m.


@pytest.mark.parametrize("task", sorted(TASKS))
def test_our_own_tasks_have_a_camera_for_it(task: str):
    assert choose_camera(make_env(task).mj_model, None).name == "camera track"


def test_arrows_show_what_a_robot_is_commanded():
    model = _model(ROBOT, HIP)
    scene, data = mujoco.MjvScene(model, 8), mujoco.MjData(model)
    quarter = np.sqrt(0.5)
    turned = [0.0, 0.0, 1.0, quarter, 0.0, 0.0, quarter, *np.zeros(model.nq - 7)]
    command = put(data, np.array([*turned, 1.0, 0.0, 0.4]))
    assert command.tolist() == [1.0, 0.0, 0.4]
    mujoco.mj_forward(model, data)
    show_command(scene, model, data, free_robot(model), command)
    way, turn = scene.geoms[0], scene.geoms[1]
    assert scene.ngeom == 2
    np.testing.assert_allclose(way.mat[:, 2], [0.0, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(turn.mat[:, 2], [0.0, 0.0, 1.0], atol=1e-6)
    assert way.size[2] / turn.size[2] == pytest.approx(1.0 / 0.4)
    assert turn.pos[2] > data.geom_xpos[:, 2].max()
    show_command(scene, model, data, free_robot(model), np.zeros(3))
    assert scene.ngeom == 2
