"""`python -m gmijax.play` as a user runs it, on a policy that nobody has trained."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import imageio_ffmpeg
import pytest
from made_checkpoint import ENV_STEPS, make_run
from training_jobs import train

pytestmark = pytest.mark.timeout(600)


def play(*overrides: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return train(*overrides, cwd=cwd, command="play")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory with one run, `runs/made`."""
    folder = tmp_path_factory.mktemp("home")
    make_run(folder / "runs" / "made")
    return folder


def test_films_have_the_wanted_size_and_play_in_real_time(home: Path):
    wanted = ("num_envs=3", "video_envs=3", "video=both", "width=200", "height=160")
    done = play("run.dir=last", *wanted, "max_steps=40", cwd=home)
    if "no headless OpenGL" in done.stderr:
        assert done.returncode == 1
        pytest.skip("neither EGL nor OSMesa on this machine: nothing can be drawn")
    assert done.returncode == 0, done.stderr
    folder = home / "runs" / "made" / "play" / f"{ENV_STEPS:012d}"
    returns = json.loads((folder / "returns.json").read_text())
    longest = max(item["length"] for item in returns["episodes"])
    assert f"page: {(folder / 'view.html').relative_to(home)}\n" in done.stdout
    assert "__VISER_EMBED_DATA__" in (folder / "view.html").read_text()
    for name, fps in (("video.mp4", 25.0), ("video.gif", 12.5)):
        check_film(folder / name, fps, longest, done.stdout)
    assert "filmed by camera track" in done.stdout
    assert not (folder / "model.mjb").exists()


def check_film(film: Path, fps: float, num_steps: int, output: str) -> None:
    """It shows that many steps in real time, in pictures of 200 x 160."""
    assert f"video: {Path(*film.parts[-5:])}\n" in output
    num_frames, duration_s = imageio_ffmpeg.count_frames_and_secs(str(film))
    # Steps of 0.01 s, the start included, and the last picture stays for its own time.
    assert num_frames == -(-(num_steps + 1) // round(100 / fps))
    assert duration_s == pytest.approx(num_steps * 0.01, abs=1.6 / fps)
    reader = imageio_ffmpeg.read_frames(str(film))
    assert next(reader)["size"] == (200, 160)
    assert len(set(next(reader))) > 20, "the picture must not be blank"
    reader.close()


def test_what_only_the_child_knows_is_bad_input_too(home: Path):
    done = play("run.dir=runs/made", "camera=nose", cwd=home)
    assert done.returncode == 2, done.stderr
    assert "camera=nose: unknown camera of ball_balance" in done.stderr
    assert done.stderr.count("\n") == 1
