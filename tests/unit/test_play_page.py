"""The page of `play`: what Brax's viewer reads from it."""

from __future__ import annotations

import base64
import json
import re
import zlib
from importlib import resources
from pathlib import Path
from typing import Any

import brax
import mujoco
import numpy as np
import pytest

from gmijax.runs.folder import PlayPaths
from gmijax.sim.trajectory import Trajectory
from gmijax.workers.page_writer import page

NUM_STEPS = 10
CONTROL_DT_S = 0.01


def model_of(asset: str) -> mujoco.MjModel:
    text = resources.files("gmijax.sim").joinpath("assets", f"{asset}.xml").read_text()
    return mujoco.MjModel.from_xml_string(text)


def falling(model: mujoco.MjModel) -> Trajectory:
    """Two worlds of which the second ends early; its free joint moves up by a metre a step."""
    qpos = np.tile(model.qpos0, (NUM_STEPS + 1, 2, 1)).astype(np.float32)
    qpos[:, 1, 2] += np.arange(NUM_STEPS + 1)
    return Trajectory(qpos, np.array([NUM_STEPS, NUM_STEPS - 2]), CONTROL_DT_S)


def read(text: str) -> dict[str, Any]:
    """What the page's own script makes of it."""
    packed = re.search(r'var system = "([^"]+)";', text)
    assert packed is not None
    return json.loads(zlib.decompress(base64.b64decode(packed[1])))


@pytest.mark.parametrize("asset", ["ant", "ball_balance"])
def test_every_visible_geom_hangs_on_a_body_that_has_a_pose_in_every_frame(asset: str):
    model = model_of(asset)
    data = read(page(model, falling(model)))
    geoms = [geom for link in data["geoms"].values() for geom in link]
    assert len(geoms) == sum(model.geom_group <= 2)
    assert {len(geom["pos"]) for geom in geoms} == {3}
    frames = data["states"]["x"]
    for geom in geoms:
        assert -1 <= geom["link_idx"] < model.nbody - 1
    for frame in frames:
        assert np.shape(frame["pos"]) == (model.nbody - 1, 3)
        assert np.shape(frame["rot"]) == (model.nbody - 1, 4)
    # 100 steps a second: every second one, up to the end of the median world's episode.
    assert len(frames) == NUM_STEPS // 2
    assert data["opt"]["timestep"] == pytest.approx(0.02)


def test_bodies_are_where_mujoco_has_them():
    model = model_of("ant")
    trajectory = falling(model)
    frames = read(page(model, trajectory))["states"]["x"]
    data = mujoco.MjData(model)
    data.qpos[:] = trajectory.qpos[8, 1]
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(frames[4]["pos"], data.xpos[1:], atol=1e-5)
    np.testing.assert_allclose(frames[4]["rot"], data.xquat[1:], atol=1e-5)


MIXED = """<mujoco>
  <asset><material name="red" rgba="1 0 0 1"/></asset>
  <worldbody>
    <body><freejoint/>
      <geom size="0.1" material="red"/>
      <geom size="0.1" group="3"/>
      <geom size="0.1" rgba="0 0 1 0"/>
    </body>
    <body><freejoint/><geom size="0.1" group="3"/></body>{more}
  </worldbody>
</mujoco>"""


def test_what_mujoco_would_not_draw_is_left_out_and_materials_colour_the_rest():
    model = mujoco.MjModel.from_xml_string(MIXED.format(more=""))
    geoms = read(page(model, falling(model)))["geoms"]
    assert [[geom["rgba"] for geom in link] for link in geoms.values()] == [[[1.0, 0.0, 0.0, 1.0]]]


def test_a_shape_that_the_viewer_does_not_know_is_told():
    more = '<geom type="ellipsoid" size="0.1 0.2 0.3"/>'
    model = mujoco.MjModel.from_xml_string(MIXED.format(more=more))
    with pytest.raises(ValueError, match="knows no geoms of type ellipsoid"):
        page(model, falling(model))


def test_the_viewer_is_that_of_the_installed_brax(tmp_path: Path):
    model = model_of("ant")
    text = page(model, falling(model))
    assert f"google/brax@v{brax.__version__}/brax/visualizer/js/viewer.js" in text
    assert PlayPaths(tmp_path).html in PlayPaths(tmp_path).results()
