"""Pictures of a vector environment, drawn in the process of a user who has set nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]

# A point that moves along a slide, and looks like a ball.
TASK = f"""
import sys
sys.path.insert(0, {str(TESTS)!r})
import mujoco
from toy_env import point_mass_env

XML = '''<mujoco><statistic extent="3" center="0 0 0"/><worldbody><light pos="0 0 3"/>
<body><joint type="slide" axis="1 0 0"/><geom size="0.3" mass="1" rgba="1 0 0 1"/></body>
</worldbody></mujoco>'''

def make(*, impl, max_envs):
    return point_mass_env()._replace(mj_model=mujoco.MjModel.from_xml_string(XML))
"""
SCRIPT = """
import warnings
import gmijax
warnings.simplefilter("ignore")  # Of this CPU.
envs = gmijax.make_vector_env("ball.py:make", 3, render_mode="rgb_array")
envs.reset(seed=0)
pictures = envs.render()
assert len(pictures) == 3
assert all(one.shape == (480, 640, 3) and len({*one.ravel().tolist()}) > 20 for one in pictures)
assert (pictures[0] != pictures[1]).any()
envs.close()
print("drawn")
"""


def test_a_user_who_has_set_nothing_gets_pictures(tmp_path: Path):
    (tmp_path / "ball.py").write_text(TASK)
    unset = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")
    environment = {key: value for key, value in os.environ.items() if key not in unset}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    if "no headless OpenGL" in done.stderr:
        assert "ConfigError: render_mode=rgb_array" in done.stderr
        pytest.skip("neither EGL nor OSMesa on this machine: nothing can be drawn")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == "drawn"
