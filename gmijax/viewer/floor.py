"""Floor and sky of the viewer, as the films have them. No jax here."""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np
import numpy.typing as npt
import trimesh
import viser
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

_REACH_M: Final = 60.0
"""From the middle of a floor without end to its edge, which fog hides."""

_TILE_M: Final = 0.5
_HAZE: Final = (237, 242, 247)
"""Colour of sky and fog, that of our models at the horizon."""

_TILES: Final = ((219, 224, 230), (201, 209, 217))


class Floor:
    """The planes of a model, in its own tiles.

    Args:
      server: viser's.
      model: a `mujoco.MjModel`.
    """

    def __init__(self, server: viser.ViserServer, model: Any) -> None:
        self._frame = server.scene.add_frame("/floor", show_axes=False)
        self._period_m = 2.0 * _TILE_M
        planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        for plane in map(int, planes):
            picture, self._period_m = _tiles(model, plane)
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, data.geom_xmat[plane])
            server.scene.add_mesh_trimesh(
                f"/floor/{plane}",
                _quad(picture, self._period_m),
                position=data.geom_xpos[plane],
                wxyz=quat,
                cast_shadow=False,
            )

    def move(self, shift: npt.NDArray[Any]) -> None:
        """Moves the view by `shift` [3], m, over a floor that never ends."""
        self._frame.position = -np.fmod(shift, self._period_m)


def set_haze(server: viser.ViserServer, distance_m: float) -> None:
    """Draws a sky of one colour, and fog of the same that begins well behind `distance_m`."""
    server.scene.set_background_image(np.full((2, 2, 3), _HAZE, np.uint8), "png")
    near, far = 4.0 * distance_m, 12.0 * distance_m
    server.scene.configure_fog(
        min(near, 0.4 * _REACH_M), min(far, _REACH_M), color=linear(np.array(_HAZE))
    )


def linear(colors: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Colours as the page takes those of fog and of vertices: sRGB without its gamma."""
    shade = colors / 255.0
    light = np.where(shade <= 0.04045, shade / 12.92, ((shade + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light).astype(np.uint8)


def _quad(picture: Image.Image, period_m: float) -> trimesh.Trimesh:
    """A square of `_REACH_M` around its middle, whose tiles repeat."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    repeats = _REACH_M / period_m
    material = PBRMaterial(baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=0.9)
    return trimesh.Trimesh(
        np.pad(_REACH_M * corners, ((0, 0), (0, 1))),
        [[0, 1, 2], [0, 2, 3]],
        visual=TextureVisuals(uv=repeats * corners, material=material),
        process=False,
    )


def _tiles(model: Any, plane: int) -> tuple[Image.Image, float]:
    """A picture of tiles that repeats, and how many metres it covers."""
    material = model.geom_matid[plane]
    role = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
    texture = model.mat_texid[material, role] if material >= 0 else -1
    if texture < 0:
        light, dark = _TILES
        pixels = np.array([[light, dark], [dark, light]], np.uint8).repeat(64, 0).repeat(64, 1)
        return Image.fromarray(pixels), 2.0 * _TILE_M
    height, width = model.tex_height[texture], model.tex_width[texture]
    channels, start = model.tex_nchannel[texture], model.tex_adr[texture]
    flat = model.tex_data[start : start + height * width * channels]
    pixels = np.flipud(flat.reshape(height, width, channels)[..., :3])
    # `texuniform`: so many repeats a metre; else over the whole plane, which may have no end.
    repeats = float(model.mat_texrepeat[material, 0]) if model.mat_texuniform[material] else 1.0
    return Image.fromarray(np.ascontiguousarray(pixels)), 1.0 / max(repeats, 1e-3)
