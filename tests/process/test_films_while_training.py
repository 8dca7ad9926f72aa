"""A job that films its evaluations."""

from __future__ import annotations

from pathlib import Path

import imageio_ffmpeg
import pytest
from training_jobs import DRAWN_TASK, POINT, STEPS, train

from gmijax.machine.opengl import first_opengl, opengls


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
    assert f"video: run/videos/{names[1]}\n" in done.stdout
    assert not (run / "film.log").exists()

    film = str(run / "videos" / names[1])
    num_frames, _ = imageio_ffmpeg.count_frames_and_secs(film)
    assert num_frames in range(2, 22)  # A frame for each step of 0.1 s, the start included.
    reader = imageio_ffmpeg.read_frames(film)
    assert next(reader)["size"] == (640, 520)  # With two lines below the picture.
    assert len(set(next(reader))) > 20, "the picture must not be blank"
    reader.close()
