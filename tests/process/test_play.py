"""`python -m gmijax.play` as a user runs it, on a policy that has hardly been trained."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import imageio_ffmpeg
import pytest
from training_jobs import train

TINY = (
    *("env=ball_balance", "num_envs=32", "num_timesteps=256", "plan.gpus=1"),
    *("algo.unroll_length=4", "algo.num_updates_per_batch=1", "run.measure_throughput=false"),
    *("algo.policy_hidden_layer_sizes=[8]", "algo.value_hidden_layer_sizes=[8]"),
)

pytestmark = pytest.mark.timeout(600)


def play(*overrides: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return train(*overrides, cwd=cwd, command="play")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory with one run, `runs/tiny`: two iterations, a checkpoint after each."""
    folder = tmp_path_factory.mktemp("home")
    done = train(*TINY, "run.name=tiny", "run.checkpoint_every=1", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder


def test_returns_are_shown_and_written_and_the_same_for_a_seed(home: Path):
    shared = ("checkpoint=128", "num_envs=4", "deterministic=false", "max_steps=40", "seed=1")
    folder = home / "runs" / "tiny" / "play" / "000000000128"
    played: list[list[float]] = []
    for _ in range(2):
        done = play("run.dir=last", *shared, "video=none", "html=off", cwd=home)
        assert done.returncode == 0, done.stderr
        returns = json.loads((folder / "returns.json").read_text())
        played.append([item["return"] for item in returns["episodes"]])
    assert played[0] == played[1]
    assert str(folder / "returns.json") in done.stdout
    assert "balance" in done.stdout
    assert returns["env_steps"] == 128
    assert len(played[0]) == returns["num_envs"] == 4
    mean = sum(played[0]) / 4
    assert returns["return"]["mean"] == pytest.approx(mean, rel=1e-5)
    assert f"{mean:.2f}" in done.stdout
    for item in returns["episodes"]:
        assert not (item["terminated"] and item["truncated"])
        assert item["return"] == pytest.approx(sum(item["terms"].values()), rel=1e-4)
    assert not (folder / "video.mp4").exists()
    assert not (folder / "view.html").exists()


def test_films_have_the_wanted_size_and_play_in_real_time(home: Path):
    wanted = ("num_envs=3", "video_envs=3", "video=both", "width=200", "height=160")
    done = play("run.dir=runs/tiny", *wanted, "max_steps=60", cwd=home)
    if "no headless OpenGL" in done.stderr:
        assert done.returncode == 1
        pytest.skip("neither EGL nor OSMesa on this machine: nothing can be drawn")
    assert done.returncode == 0, done.stderr
    folder = home / "runs" / "tiny" / "play" / "000000000256"
    longest = max(
        item["length"] for item in json.loads((folder / "returns.json").read_text())["episodes"]
    )
    assert f"page: {folder / 'view.html'}" in done.stdout
    assert "brax-viewer" in (folder / "view.html").read_text()
    for name, fps in (("video.mp4", 25.0), ("video.gif", 12.5)):
        assert f"video: {folder / name}" in done.stdout
        num_frames, duration_s = imageio_ffmpeg.count_frames_and_secs(str(folder / name))
        # Steps of 0.01 s, the start included, and the last picture stays for its own time.
        assert num_frames == -(-(longest + 1) // round(100 / fps))
        assert duration_s == pytest.approx(longest * 0.01, abs=1.6 / fps)
        reader = imageio_ffmpeg.read_frames(str(folder / name))
        assert next(reader)["size"] == (200, 160)
        assert len(set(next(reader))) > 20, "the picture must not be blank"
        reader.close()


def test_what_only_the_child_knows_is_bad_input_too(home: Path):
    done = play("run.dir=runs/tiny", "camera=nose", cwd=home)
    assert done.returncode == 2, done.stderr
    assert "camera=nose: unknown camera of ball_balance" in done.stderr
    assert done.stderr.count("\n") == 1
