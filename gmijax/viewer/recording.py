"""Episodes as a page that needs no server: viser's own, with the scene and its motion in it."""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np

from gmijax.sim.stage import body_poses
from gmijax.sim.trajectory import Trajectory
from gmijax.viewer.guard import Guard
from gmijax.viewer.scene import Scene
from gmijax.viewer.server import close_server, open_server

MAX_FPS: Final = 25.0
"""Pictures per second of the page, which moves in between."""


def page(model: Any, trajectory: Trajectory) -> str:
    """A page that plays `trajectory` in real time, with a timeline; it loads nothing.

    Args:
      model: a `mujoco.MjModel`, of which nothing is changed.
      trajectory: its environments stand side by side; one whose episode is over stays as it is.
    """
    num_steps, num_envs = trajectory.qpos.shape[:2]
    stride = max(1, round(1.0 / (trajectory.control_dt_s * MAX_FPS)))
    # viser records what a server shows; no client connects to this one.
    server = open_server(Guard("127.0.0.1"), 0)
    try:
        scene = Scene(server, model, num_envs, has_ring=False)
        scene.label(trajectory.labels)
        recording = server.get_scene_serializer()
        data = mujoco.MjData(model)
        for step in range(0, num_steps, stride):
            poses = [
                body_poses(model, data, trajectory.qpos[min(step, int(length)), env])
                for env, length in enumerate(trajectory.lengths)
            ]
            xpos, xquat = (np.stack(found) for found in zip(*poses, strict=True))
            scene.show(xpos, xquat, 0, follow=True)
            recording.insert_sleep(stride * trajectory.control_dt_s)
        return recording.as_html()
    finally:
        close_server(server)
