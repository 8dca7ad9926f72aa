"""Main of the page-writing child of `gmijax.play`, `page_writer.py PLAY_FOLDER`.

Turns the trajectory of the median world into a page that shows it in 3D in a browser, with the
viewer of `brax.io.html`. The page holds the geometry and the motion; the viewer itself comes from
the internet (jsdelivr.net, unpkg.com) when the page is opened.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.runs.folder import PlayPaths
from gmijax.sim.stage import put
from gmijax.sim.trajectory import Trajectory, load_trajectory
from gmijax.workers.play_film import real_time

MAX_FPS = 60.0

Floats: TypeAlias = npt.NDArray[np.float32]

_LAST_VISIBLE_GROUP = 2
"""MuJoCo's own viewers draw geoms of groups 0 to 2, unless they are told otherwise."""

_DRAWN = ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "CYLINDER", "BOX", "MESH")


class Frame(NamedTuple):
    """One state for Brax's writer, which reads nothing but `x`."""

    x: Any


def main() -> int:
    """Writes the page; returns the exit code."""
    paths = PlayPaths(Path(sys.argv[1]))
    model = mujoco.MjModel.from_binary_path(str(paths.model))
    try:
        text = page(model, load_trajectory(paths.trajectory))
    except Exception as error:  # Whatever Brax does not know of a model: no two raise alike.
        sys.stderr.write(f"{type(error).__name__}: {' '.join(str(error).split())}\n")
        return 1
    partial = paths.html.with_name(f".{paths.html.name}")
    partial.write_text(text)
    os.replace(partial, paths.html)
    return 0


def page(model: mujoco.MjModel, trajectory: Trajectory) -> str:
    """The page of the median world of `trajectory`, in real time.

    Raises:
      Exception: of any type, for a model that Brax cannot represent.
    """
    from brax.base import Transform
    from brax.io import html, mjcf
    from brax.io import json as brax_json

    _check_shapes(model)
    timing = real_time(trajectory.control_dt_s, MAX_FPS)
    world = len(trajectory.lengths) // 2  # Of those by the order of their returns.
    qpos = trajectory.qpos[: trajectory.lengths[world] + 1 : timing.stride, world]
    frames: list[Any] = []
    for row in qpos:
        pos, rot = poses_of(model, row)
        frames.append(Frame(Transform(pos=pos, rot=rot)))  # pyright: ignore[reportArgumentType]
    _paint(model)
    system = mjcf.load_model(model)
    data = json.loads(brax_json.dumps(system, frames))
    data["opt"]["timestep"] = 1.0 / timing.fps
    names = [name or f"link {i}" for i, name in enumerate(system.link_names)]
    _hide(data["geoms"], model, [*names, "world"])
    return html.render_from_json(json.dumps(data), "100vh", colab=False, base_url=None)


def poses_of(model: mujoco.MjModel, qpos: npt.NDArray[Any]) -> tuple[Floats, Floats]:
    """Positions [B, 3] and quaternions [B, 4] of all bodies but the world, by `Env.qpos`."""
    data = mujoco.MjData(model)
    put(data, qpos)
    mujoco.mj_kinematics(model, data)
    return data.xpos[1:].astype(np.float32), data.xquat[1:].astype(np.float32)


def _check_shapes(model: mujoco.MjModel) -> None:
    drawn = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in _DRAWN}
    if others := sorted(set(map(int, model.geom_type)) - drawn):
        names = [mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in others]
        raise ValueError(f"Brax's viewer knows no geoms of type {', '.join(names)}")


def _paint(model: mujoco.MjModel) -> None:
    """Gives geoms the colour of their material, which Brax's viewer knows nothing of."""
    painted = model.geom_matid >= 0
    model.geom_rgba[painted] = model.mat_rgba[model.geom_matid[painted]]


def _hide(geoms: dict[str, list[Any]], model: mujoco.MjModel, names: list[str]) -> None:
    """Takes out what MuJoCo would not draw; `geoms` are those of each link, in their order."""
    rest = {name: iter(items) for name, items in list(geoms.items())}
    seen: dict[str, list[Any]] = {}
    for geom in range(model.ngeom):
        name = names[model.geom_bodyid[geom] - 1]
        item = next(rest[name])
        if model.geom_group[geom] <= _LAST_VISIBLE_GROUP and model.geom_rgba[geom, 3] > 0.0:
            seen.setdefault(name, []).append(item)
    geoms.clear()
    geoms.update(seen)


if __name__ == "__main__":
    sys.exit(main())
