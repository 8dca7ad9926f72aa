"""What the browser shows: the bodies of several environments on one floor. No jax here.

Shapes come from mjviser, which turns MuJoCo's into meshes. The rest is ours: its own scene draws a
model once where it stands still, and all environments at the origin.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt
import trimesh
import viser
from mjviser.conversions import group_geoms_by_visual_compat, merge_geoms
from trimesh.visual import ColorVisuals

from gmijax.sim.camera import free_robot
from gmijax.viewer.floor import Floor, linear, set_haze
from gmijax.viewer.requests import Drag

Floats: TypeAlias = npt.NDArray[np.floating]

Color: TypeAlias = tuple[int, int, int]
Arrow: TypeAlias = tuple[Floats, Floats]

_LAST_VISIBLE_GROUP: Final = 2
"""MuJoCo's own viewers draw geoms of groups 0 to 2, unless they are set otherwise."""

_GAP: Final = 1.5
"""From one environment to the next, in widths of the model."""

_LIGHT: Final = (-2.0, -3.0, 6.0)
_FROM: Final = np.array([-0.55, -0.75, 0.38])
"""Direction from what is looked at to the camera."""

_UP: Final = (0.0, 0.0, 1.0)
ORANGE: Final = (235, 140, 40)
BLUE: Final = (60, 130, 200)


class _Part(NamedTuple):
    handle: Any  # Of an instance in each environment.
    body: int


class Scene:
    """Bodies of `num_envs` environments, side by side.

    Args:
      server: viser's; what it has been showing goes.
      model: a `mujoco.MjModel`, of which nothing is changed.
      num_envs: E.
      has_ring: whether the selected environment has a ring around it.
    """

    def __init__(
        self, server: viser.ViserServer, model: Any, num_envs: int, *, has_ring: bool
    ) -> None:
        self._server, self._model = server, model
        self._robot = moving_robot(model)
        self._start = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self._start)
        low, high = bounds(model, self._start)
        self._width = float(max(high[0] - low[0], high[1] - low[1], 0.2))
        self._top = float(high[2])
        self._offsets = offsets(num_envs, _GAP * self._width)
        self._shift = np.zeros(3)
        server.scene.reset()
        server.scene.set_up_direction("+z")
        self._set_light()
        self._floor = Floor(server, model)
        self._fixed = server.scene.add_frame("/fixed", show_axes=False)
        self._parts = self._add_bodies()
        self._ring = self._add_ring(has_ring)
        self._arrows: dict[str, Any] = {}
        self._set_camera(low, high)

    @property
    def has_robot(self) -> bool:
        """Whether the model has a robot that moves freely, which the view can follow."""
        return self._robot is not None

    @property
    def width_m(self) -> float:
        """Of the model at the start."""
        return self._width

    def show(self, xpos: Floats, xquat: Floats, selected: int, *, follow: bool) -> None:
        """Draws poses.

        Args:
          xpos: [E, B, 3] positions of all bodies, m, as `mujoco.MjData.xpos`.
          xquat: [E, B, 4] their orientations, w first.
          selected: the environment with the ring.
          follow: keep its robot in the middle, if there is one that leaves.
        """
        shift = np.zeros(3)
        if follow and self._robot is not None:
            # Not its height: the floor would jump.
            shift[:2] = xpos[selected, self._robot, :2]
        self._shift = shift
        placed = xpos + (self._offsets - shift)[:, None, :]
        with self._server.atomic():
            self._floor.move(shift)
            self._fixed.position = -shift
            self._ring.position = self._ring_position(placed, selected)
            for part in self._parts:
                part.handle.batched_positions = placed[:, part.body]
                part.handle.batched_wxyzs = xquat[:, part.body]
        self._server.flush()

    def show_arrows(self, name: str, color: Color, arrows: Mapping[int, Arrow]) -> None:
        """Draws arrows (from [3], to [3]) of environments; replaces those of that name."""
        handle = self._arrows.get(name)
        if not arrows:
            if handle is not None and handle.visible:
                handle.visible = False
            return
        moved = {env: self._offsets[env] - self._shift for env in arrows}
        points = np.array([np.add(ends, moved[env]) for env, ends in arrows.items()], np.float32)
        if handle is None:
            size = 0.02 * self._width
            self._arrows[name] = self._server.scene.add_arrows(
                f"/arrows/{name}",
                points,
                color,
                shaft_radius=size,
                head_radius=2.5 * size,
                head_length=5.0 * size,
            )
            return
        handle.points = points
        if not handle.visible:
            handle.visible = True

    def label(self, texts: Sequence[str]) -> None:
        """Writes a text above each of the first environments."""
        above = np.array([0.0, 0.0, 0.3 * self._width + self._top])
        for number, text in enumerate(texts):
            self._server.scene.add_label(
                f"/fixed/label/{number}", text, position=self._offsets[number] + above
            )

    def on_drag(self, callback: Callable[[Drag], None]) -> None:
        """Has `callback` called while a body is pulled with ctrl and the left button."""
        for part in self._parts:
            # A function of its own for each part. Async ones are called in the order of events.
            async def pulled(event: Any, body: int = part.body) -> None:
                env = event.instance_index or 0
                back = self._shift - self._offsets[env]
                pointer = None if event.phase == "end" else np.array(event.end_position) + back
                grabbed = np.array(event.start_position) + back
                callback(Drag(env, body, grabbed, pointer))

            part.handle.on_drag("left", modifier="cmd/ctrl")(pulled)

    def on_select(self, callback: Callable[[int], None]) -> None:
        """Has `callback` called with the environment of a body that is clicked."""

        async def clicked(event: Any) -> None:
            callback(event.instance_index or 0)

        for part in self._parts:
            part.handle.on_click(clicked)

    def _add_bodies(self) -> list[_Part]:
        num_envs, parts = len(self._offsets), []
        for body, geoms in visible_geoms(self._model).items():
            fixed = is_fixed(self._model, body)
            for number, same in enumerate(group_geoms_by_visual_compat(self._model, geoms)):
                handle = self._server.scene.add_batched_meshes_trimesh(
                    f"{'/fixed' if fixed else ''}/bodies/{body}/{number}",
                    with_linear_colors(merge_geoms(self._model, same)),
                    np.tile(self._start.xquat[body], (num_envs, 1)),
                    self._offsets + self._start.xpos[body],
                    lod="off",
                )
                if not fixed:
                    parts.append(_Part(handle, body))
        return parts

    def _add_ring(self, visible: bool) -> Any:
        radius = 0.55 * self._width
        ring = trimesh.creation.annulus(0.98 * radius, radius, 0.01 * radius, sections=96)
        return self._server.scene.add_mesh_simple(
            "/ring",
            ring.vertices,
            ring.faces,
            color=BLUE,
            cast_shadow=False,
            visible=visible,
        )

    def _ring_position(self, placed: Floats, selected: int) -> Floats:
        if self._robot is None:
            return self._offsets[selected]
        return placed[selected, self._robot] * (1.0, 1.0, 0.0)

    def _set_light(self) -> None:
        scene = self._server.scene
        scene.configure_environment_map("studio", environment_intensity=0.35)
        scene.configure_default_lights(enabled=False)
        scene.add_light_directional("/light", intensity=2.0, cast_shadow=True, position=_LIGHT)

    def _set_camera(self, low: Floats, high: Floats) -> None:
        across = float(np.ptp(self._offsets, axis=0).max())
        distance = 1.6 * float(np.linalg.norm(high - low)) + 0.9 * across
        middle, way = (low + high) / 2, distance * _FROM / np.linalg.norm(_FROM)
        camera = self._server.initial_camera
        camera.look_at, camera.position, camera.up = middle, middle + way, np.array(_UP)
        camera.fov = math.radians(45.0)
        camera.near, camera.far = distance / 200.0, 100.0 * distance
        set_haze(self._server, distance)

        @self._server.on_client_connect
        async def _(client: viser.ClientHandle) -> None:
            if client.camera.aspect < 1.0:  # A phone: the panel covers the lower half.
                farther = 0.9 / client.camera.aspect
                below = middle - (0.0, 0.0, 0.25 * farther * distance)
                client.camera.position = below + farther * way
                client.camera.look_at = below  # It has moved too.


def offsets(num_envs: int, spacing_m: float) -> Floats:
    """Where the environments stand, [E, 3] m: a grid around the origin, as square as possible."""
    columns = math.ceil(math.sqrt(num_envs))
    rows = math.ceil(num_envs / columns)
    number = np.arange(num_envs)
    at = np.stack([number % columns - (columns - 1) / 2, number // columns - (rows - 1) / 2], -1)
    return np.pad(spacing_m * at, ((0, 0), (0, 1)))


def visible_geoms(model: Any) -> dict[int, list[int]]:
    """Geoms that MuJoCo's viewers draw, without planes, by their body."""
    found: dict[int, list[int]] = {}
    for geom in range(model.ngeom):
        material = model.geom_matid[geom]
        alpha = model.geom_rgba[geom, 3] if material < 0 else model.mat_rgba[material, 3]
        is_plane = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
        if is_plane or alpha == 0.0 or model.geom_group[geom] > _LAST_VISIBLE_GROUP:
            continue
        found.setdefault(int(model.geom_bodyid[geom]), []).append(geom)
    return found


def with_linear_colors(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with the colours of its vertices as its format means them; else they are pale."""
    visual: Any = mesh.visual
    if isinstance(visual, ColorVisuals):
        colors = np.array(visual.vertex_colors)
        colors[:, :3] = linear(colors[:, :3])
        mesh.visual = ColorVisuals(mesh, vertex_colors=colors)
    return mesh


def is_fixed(model: Any, body: int) -> bool:
    """Whether a body never moves."""
    return model.body_weldid[body] == 0 and model.body_mocapid[model.body_rootid[body]] < 0


def moving_robot(model: Any) -> int | None:
    """The robot that can move away; None: there is none, or it is fixed to the ground."""
    robot = free_robot(model)
    kinds = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
    ties = [one for one in range(model.neq) if model.eq_type[one] in kinds]
    tied = any(0 in (model.eq_obj1id[one], model.eq_obj2id[one]) for one in ties)
    return None if tied else robot


def bounds(model: Any, data: Any) -> tuple[Floats, Floats]:
    """Lowest and highest corner [3] of what is drawn of `data`, planes left out, m."""
    geoms = [geom for geoms in visible_geoms(model).values() for geom in geoms]
    if not geoms:
        return np.full(3, -0.5), np.full(3, 0.5)
    reach = model.geom_rbound[geoms, None]
    return (data.geom_xpos[geoms] - reach).min(axis=0), (data.geom_xpos[geoms] + reach).max(axis=0)
