"""Draws one environment with MuJoCo, without a display. No jax here.

MuJoCo chooses its OpenGL when it is imported, from MUJOCO_GL: see `gmijax.machine.opengl`.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.sim.camera import choose_camera, free_robot

Image: TypeAlias = npt.NDArray[np.uint8]

_ABOVE_M, _ARROW_M = 0.1, 0.02
"""Height of the arrows of a command above a robot, and their thickness."""
_M_PER_SPEED, _LEAST_SPEED = 0.5, 0.02
"""Length of such an arrow for 1 m/s or 1 rad/s, and where it is left out."""
_WAY, _TURN = (0.2, 0.8, 0.2, 1.0), (0.2, 0.4, 1.0, 1.0)

_SHADOW_MAP = 1024
"""Pixels of its side: software OpenGL spends most of its time on larger ones."""


class Stage:
    """A model, a camera, and an off-screen OpenGL context.

    Args:
      model: a `mujoco.MjModel`, or its file in MuJoCo's binary format; None: an empty scene.
      size: width and height of a picture, pixels.
      camera: see `gmijax.sim.camera.choose_camera`.

    Raises:
      Exception: of any type, where OpenGL cannot be had.
    """

    def __init__(self, model: Any, size: tuple[int, int], camera: str | None) -> None:
        import mujoco

        self._mujoco = mujoco
        if model is None:
            self._model = mujoco.MjModel.from_xml_string("<mujoco/>")
        elif isinstance(model, Path):
            self._model = mujoco.MjModel.from_binary_path(str(model))
        else:
            # A copy, because its buffer is changed below.
            self._model = copy.copy(model)
        self._data = mujoco.MjData(self._model)
        width, height = size
        self._make_cheap(width, height)
        self._view = choose_camera(self._model, camera).view
        self._renderer = mujoco.Renderer(self._model, height, width)
        self._renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_REFLECTION)] = False
        self.picture(self._model.qpos0)

    def _make_cheap(self, width: int, height: int) -> None:
        """Settings for machines without a GPU: a fifth of the time of our models' own."""
        visual = self._model.vis
        # All of the buffer is resolved, not only the picture.
        visual.global_.offwidth, visual.global_.offheight = width, height
        visual.quality.shadowsize = min(visual.quality.shadowsize, _SHADOW_MAP)
        visual.quality.offsamples = 0  # One sample, in a buffer that knows nothing of several.

    def close(self) -> None:
        """Frees the context."""
        self._renderer.close()

    def picture(self, qpos: npt.NDArray[Any]) -> Image:
        """The picture [height, width, 3] of an environment at `qpos`, as a `Trajectory` has it."""
        command = put(self._data, qpos)
        self._mujoco.mj_fwdPosition(self._model, self._data)
        self._renderer.update_scene(self._data, self._view)
        if command.size and (robot := free_robot(self._model)) is not None:
            show_command(self._renderer.scene, self._model, self._data, robot, command)
        return self._renderer.render()


def show_command(scene: Any, model: Any, data: Any, robot: int, command: npt.NDArray[Any]) -> None:
    """Adds arrows to a scene, above a robot, 0.5 m for 1 m/s or 1 rad/s.

    They show where to, and upwards a left turn.

    Args:
      scene: the `mujoco.MjvScene`.
      model: the `mujoco.MjModel`.
      data: its `mujoco.MjData`, with the poses of bodies.
      robot: a body.
      command: [3], m/s forwards and to the left, rad/s.
    """
    own = model.body_rootid[model.geom_bodyid] == model.body_rootid[robot]
    top = data.geom_xpos[own, 2].max(initial=data.xpos[robot, 2]) + _ABOVE_M
    start = np.array([*data.xpos[robot, :2], top])
    ahead = data.xmat[robot].reshape(3, 3)[:2, 0]
    forwards = ahead / max(float(np.linalg.norm(ahead)), 1e-6)
    left = np.array([-forwards[1], forwards[0]])
    way = [*(command[0] * forwards + command[1] * left), 0.0]
    _arrow(scene, start, np.array(way), _WAY)
    _arrow(scene, start, np.array([0.0, 0.0, command[2]]), _TURN)


def _arrow(scene: Any, start: npt.NDArray[Any], speed: npt.NDArray[Any], colour: Any) -> None:
    import mujoco

    arrow = mujoco.mjtGeom.mjGEOM_ARROW
    if scene.ngeom == scene.maxgeom or np.linalg.norm(speed) < _LEAST_SPEED:
        return
    geom = scene.geoms[scene.ngeom]
    nothing = np.zeros(3)
    mujoco.mjv_initGeom(geom, arrow, nothing, nothing, np.zeros(9), np.float32(colour))
    mujoco.mjv_connector(geom, arrow, _ARROW_M, start, start + _M_PER_SPEED * speed)
    scene.ngeom += 1


def body_poses(
    model: Any, data: Any, qpos: npt.NDArray[Any]
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Positions [nbody, 3], m, and quaternions [nbody, 4] of all bodies, computed in `data`."""
    import mujoco

    put(data, qpos)
    mujoco.mj_kinematics(model, data)
    return data.xpos.copy(), data.xquat.copy()


def put(data: Any, qpos: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Moves the joints of a `mujoco.MjData`, and its mocap bodies if `qpos` has their poses.

    Returns:
      The command at the end of `qpos`, [3] or empty.
    """
    joints, rest = np.split(np.asarray(qpos), [data.qpos.size])
    data.qpos[:] = joints
    poses, command = np.split(rest, [rest.size // 7 * 7])
    if poses.size:
        pos, quat = np.split(poses, [data.mocap_pos.size])
        data.mocap_pos[:] = pos.reshape(-1, 3)
        data.mocap_quat[:] = quat.reshape(-1, 4)
    return command
