"""The page in a browser: scene, panel, and the clients that have it open. No jax here."""

from __future__ import annotations

import queue
from typing import Any, Final

import numpy as np

from gmijax.viewer import requests
from gmijax.viewer.loop import View
from gmijax.viewer.panel import Panel
from gmijax.viewer.scene import BLUE, ORANGE, Arrow, Scene
from gmijax.viewer.server import Server
from gmijax.viewer.simulation import Floats, Simulation

_ARROW: Final = 0.3
"""Length for 1 m/s, in widths of the model."""

_FORWARD, _LEFT = "forward_m_per_s", "left_m_per_s"
"""Numbers of a command that can be drawn."""


class BrowserPage:
    """Shows a simulation to all clients that have the page open.

    Args:
      server: that it is served by.
      asked: where what is asked in the page is put.
      title: of the panel.
      simulation: that is shown.
      has_run: whether there are checkpoints to choose from.
    """

    def __init__(
        self,
        server: Server,
        asked: queue.SimpleQueue[requests.Request],
        title: str,
        simulation: Simulation,
        *,
        has_run: bool,
    ) -> None:
        self._server = server
        num_envs = len(simulation.envs)
        self._scene = Scene(server, simulation.model, num_envs, has_ring=num_envs > 1)
        self._panel = Panel(
            server,
            asked,
            title,
            simulation,
            follows_robot=self._scene.has_robot,
            has_run=has_run,
        )
        self._scene.on_drag(asked.put)
        self._scene.on_select(lambda env: asked.put(requests.Select(env)))

        @server.on_client_connect
        async def _(_: Any) -> None:
            asked.put(requests.Wake())

    def num_clients(self) -> int:
        """How many have it open."""
        return len(self._server.get_clients())

    def draw(self, simulation: Simulation, view: View) -> None:
        """Shows bodies, and arrows for commands and pushes."""
        xpos, xquat = simulation.poses()
        self._scene.show(xpos, xquat, view.selected, follow=view.follow_robot)
        middle = xpos[:, simulation.pushed]
        length = _ARROW * self._scene.width_m
        pushes = {
            env: (middle[env] - length * push, middle[env])
            for env, push in simulation.pushed_lately().items()
        }
        self._scene.show_arrows("push", ORANGE, pushes)
        self._scene.show_arrows("command", BLUE, self._commands(simulation, xpos, xquat))

    def write(self, simulation: Simulation, view: View) -> None:
        """Shows numbers."""
        self._panel.write(simulation, view)

    def _commands(self, simulation: Simulation, xpos: Floats, xquat: Floats) -> dict[int, Arrow]:
        """Commanded velocities in the plane, above the robots."""
        names = list(simulation.envs[0].command_limits or ())
        if not {_FORWARD, _LEFT} <= set(names):
            return {}
        width = self._scene.width_m
        above = np.array([0.0, 0.0, 0.4 * width])
        arrows: dict[int, Arrow] = {}
        for number, env in enumerate(simulation.envs):
            command = dict(zip(names, np.asarray(env.command), strict=True))
            w, x, y, z = xquat[number, simulation.pushed]
            yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
            aside = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
            start = xpos[number, simulation.pushed] + above
            way = command[_FORWARD] * ahead + command[_LEFT] * aside
            arrows[number] = (start, start + _ARROW * width * way)
        return arrows
