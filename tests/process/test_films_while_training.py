"""A job that films its evaluations."""

from __future__ import annotations

from pathlib import Path

import imageio_ffmpeg
import pytest
from training_jobs import POINT, POINT_TASK, STEPS, train

from gmijax.machine.opengl import first_opengl, opengls

DRAWN_TASK = (
    POINT_TASK.replace("def make(", "def toy(")
    + """
import mujoco

MODEL = '''<mujoco><worldbody>
  <light pos="0 0 3"/><geom type="plane" size="3 3 1" rgba="0 0.6 0.3 1"/>
  <camera pos="0 -3 2" xyaxes="1 0 0 0 0.5 1"/>
  <body pos="0 0 0.5"><joint type="slide" axis="1 0 0"/><geom size="0.3"/></body>
</worldbody></mujoco>'''

def make(*, impl, max_envs):
    model = mujoco.MjModel.from_xml_string(MODEL)
    return toy(impl=impl, max_envs=max_envs)._replace(mj_model=model)
"""
)


@pytest.mark.timeout(300)
def test_the_last_evaluation_is_filmed_and_nothing_is_left_to_film(tmp_path: Path) -> None:
    if first_opengl(opengls("osmesa", "egl"))[0] is None:
        pytest.skip("neither EGL nor OSMesa on this machine: nothing can be drawn")
    (tmp_path / "point.py").write_text(DRAWN_TASK)
    films = (f"eval.every={STEPS}", "eval.episodes=2", "eval.video=2", "run.dir=run")
    done = train(*POINT, "plan.gpus=1", f"num_timesteps={3 * STEPS}", *films, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "run"
    names = [f"{k * STEPS:012d}.mp4" for k in (2, 3)]
    # The first one may have been waiting yet when the second came.
    assert sorted(path.name for path in (run / "videos").iterdir()) in (names, names[1:])
    assert f"video: {run / 'videos' / names[1]}\n" in done.stdout
    assert not (run / "film.log").exists()

    film = str(run / "videos" / names[1])
    num_frames, _ = imageio_ffmpeg.count_frames_and_secs(film)
    assert num_frames in range(2, 22)  # A frame for each step of 0.1 s, the start included.
    reader = imageio_ffmpeg.read_frames(film)
    assert next(reader)["size"] == (640, 480)
    assert len(set(next(reader))) > 20, "the picture must not be blank"
    reader.close()
