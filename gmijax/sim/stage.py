"""Draws one world with MuJoCo, without a display. No jax here.

MuJoCo chooses its OpenGL when it is imported, from MUJOCO_GL: see `gmijax.machine.opengl`.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.sim.camera import choose_camera

Image: TypeAlias = npt.NDArray[np.uint8]

_SHADOW_MAP = 1024
"""Pixels of its side: software OpenGL spends most of its time on larger ones."""


class Stage:
    """A model, a camera, and an off-screen OpenGL context.

    Args:
      model: a `mujoco.MjModel`, or its file in MuJoCo's binary format; None: an empty world.
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
        """The picture [height, width, 3] of one world at `qpos`, as `Env.qpos` gives it."""
        put(self._data, qpos)
        self._mujoco.mj_fwdPosition(self._model, self._data)
        self._renderer.update_scene(self._data, self._view)
        return self._renderer.render()


def body_poses(
    model: Any, data: Any, qpos: npt.NDArray[Any]
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Positions [nbody, 3], m, and quaternions [nbody, 4] of all bodies, computed in `data`."""
    import mujoco

    put(data, qpos)
    mujoco.mj_kinematics(model, data)
    return data.xpos.copy(), data.xquat.copy()


def put(data: Any, qpos: npt.NDArray[Any]) -> None:
    """Moves the joints of a `mujoco.MjData`, and its mocap bodies if `qpos` has their poses."""
    joints, rest = np.split(np.asarray(qpos), [data.qpos.size])
    data.qpos[:] = joints
    if rest.size:
        pos, quat = np.split(rest, [data.mocap_pos.size])
        data.mocap_pos[:] = pos.reshape(-1, 3)
        data.mocap_quat[:] = quat.reshape(-1, 4)
