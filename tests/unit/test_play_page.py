"""The page of `play`: what is in it moves as the trajectory does, and it loads nothing."""

from __future__ import annotations

import base64
import re
from importlib import resources
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

msgspec: Any = pytest.importorskip("msgspec")
pytest.importorskip("viser")
pytest.importorskip("mjviser")

import zstandard  # noqa: E402

from gmijax.runs.folder import PlayPaths  # noqa: E402
from gmijax.sim.trajectory import Trajectory  # noqa: E402
from gmijax.viewer.recording import page  # noqa: E402

NUM_STEPS, ENDS_AT = 40, 20
CONTROL_DT_S = 0.01


def model_of(asset: str) -> mujoco.MjModel:
    text = resources.files("gmijax.sim").joinpath("assets", f"{asset}.xml").read_text()
    return mujoco.MjModel.from_xml_string(text)


def rising(model: mujoco.MjModel) -> Trajectory:
    """Two environments of which the second ends early; a free joint moves up by a metre a step."""
    qpos = np.tile(model.qpos0, (NUM_STEPS + 1, 2, 1)).astype(np.float32)
    # What is where it was is not sent again.
    qpos[:, :, 2] += 1 + np.arange(NUM_STEPS + 1)[:, None]
    lengths = np.array([NUM_STEPS, ENDS_AT], np.int32)
    return Trajectory(qpos, lengths, CONTROL_DT_S, ("return 3", "return <b>"))


class Recording:
    """What a page holds."""

    def __init__(self, text: str) -> None:
        packed = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', text)
        assert packed is not None
        inner = zstandard.ZstdDecompressor().decompress(
            base64.b64decode(packed[1])[8:], max_output_size=1 << 28
        )
        end = 8 + int.from_bytes(inner[:8], "little")
        data = msgspec.msgpack.decode(inner[8:end])
        self.messages: list[tuple[float, dict[str, Any]]] = data["messages"]
        self.duration_s: float = data["durationSeconds"]
        self._buffers: list[bytes] = []
        for size in data["binaryBufferLengths"]:
            end += -end % 8
            self._buffers.append(inner[end : end + size])
            end += size

    def positions(self, body: int) -> list[tuple[float, Any]]:
        """When the first part of a body is moved, seconds, and to where [E, 3]."""
        found = []
        for at_s, message in self.messages:
            updates = message.get("updates", {})
            if message.get("name") == f"/bodies/{body}/0" and "batched_positions" in updates:
                number = updates["batched_positions"]["__binary_index"]
                found.append((at_s, np.frombuffer(self._buffers[number], np.float32)))
        return [(at_s, flat.reshape(-1, 3)) for at_s, flat in found]


def test_bodies_move_in_real_time_and_an_environment_whose_episode_is_over_stays() -> None:
    model = model_of("ant")
    recording = Recording(page(model, rising(model)))
    torso = model.body("torso").id
    moved = recording.positions(torso)
    # 100 steps a second: every fourth one.
    assert len(moved) == NUM_STEPS // 4 + 1
    assert recording.duration_s == pytest.approx(0.04 * len(moved))
    np.testing.assert_allclose([at_s for at_s, _ in moved], 0.04 * np.arange(len(moved)))
    heights = np.array([xpos[:, 2] - moved[0][1][:, 2] for _, xpos in moved])
    steps = 4 * np.arange(len(moved))
    np.testing.assert_allclose(heights[:, 0], steps, atol=1e-4)
    np.testing.assert_allclose(heights[:, 1], np.minimum(steps, ENDS_AT), atol=1e-4)
    # Side by side, not in one another.
    assert np.linalg.norm(moved[0][1][0] - moved[0][1][1]) > 1.0


def test_every_visible_body_is_there_and_so_are_labels() -> None:
    model = model_of("franka_cabinet")
    recording = Recording(page(model, rising(model)))
    names = {message.get("name", "") for _, message in recording.messages}
    drawn = {int(body) for name in names for body in re.findall(r"bodies/(\d+)/", name)}
    wanted = {
        int(model.geom_bodyid[geom])
        for geom in range(model.ngeom)
        if model.geom_group[geom] <= 2 and model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE
    }
    assert drawn == wanted
    assert {"/fixed/label/0", "/fixed/label/1"} <= names


MIXED = """<mujoco>
  <asset><material name="clear" rgba="1 0 0 0"/></asset>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body><freejoint/>
      <geom type="ellipsoid" size="0.1 0.2 0.3"/>
      <geom size="0.1" group="3"/>
    </body>
    <body><freejoint/><geom size="0.1" rgba="0 0 1 0"/></body>
    <body><freejoint/><geom size="0.1" material="clear"/></body>
    <body mocap="true"><geom size="0.1"/></body>
  </worldbody>
</mujoco>"""


def test_what_mujoco_would_not_draw_is_left_out() -> None:
    model = mujoco.MjModel.from_xml_string(MIXED)
    qpos = np.concatenate([model.qpos0, [1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]])
    trajectory = Trajectory(np.tile(qpos, (3, 1, 1)), np.array([2], np.int32), 0.04)
    recording = Recording(page(model, trajectory))
    names = {message.get("name", "") for _, message in recording.messages}
    drawn = {name for name in names if name.startswith("/bodies/") and name.count("/") == 3}
    assert drawn == {"/bodies/1/0", "/bodies/4/0"}
    # The pose of a mocap body is part of the trajectory.
    (_, xpos), *_ = recording.positions(4)
    assert xpos[0, 2] == pytest.approx(3.0)


def test_it_loads_nothing(tmp_path: Path) -> None:
    model = model_of("ant")
    text = page(model, rising(model))
    assert set(re.findall(r"https?://[\w.-]+", text)) <= {"http://www.w3.org"}
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=[\"'](?!data:)", text)
    assert PlayPaths(tmp_path).html in PlayPaths(tmp_path).results()
