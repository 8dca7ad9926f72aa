"""`python -m gmijax.play` as a user runs it, on a policy that has hardly been trained."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path

import imageio_ffmpeg
import pytest
from command_lines import run as run_here
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


def test_returns_are_shown_and_written(home: Path):
    done = play("run.dir=last", "num_envs=4", "video=none", "html=off", cwd=home)
    assert done.returncode == 0, done.stderr
    folder = home / "runs" / "tiny" / "play" / "000000000256"
    assert str(folder / "returns.json") in done.stdout
    assert "balance" in done.stdout
    returns = json.loads((folder / "returns.json").read_text())
    assert returns["env_steps"] == 256
    episodes = returns["episodes"]
    assert len(episodes) == returns["num_envs"] == 4
    mean = sum(item["return"] for item in episodes) / 4
    assert returns["return"]["mean"] == pytest.approx(mean, rel=1e-5)
    assert f"{mean:.2f}" in done.stdout
    for item in episodes:
        assert item["terminated"] != item["truncated"]
        assert item["return"] == pytest.approx(sum(item["terms"].values()), rel=1e-4)
    assert not (folder / "video.mp4").exists()
    assert not (folder / "view.html").exists()


def test_the_same_seed_gives_the_same_returns(home: Path):
    shared = ("checkpoint=128", "num_envs=4", "deterministic=false", "max_steps=40")
    nothing = ("video=none", "html=off")
    folder = home / "runs" / "tiny" / "play" / "000000000128"
    played: list[list[float]] = []
    for _ in range(2):
        done = play("run.dir=runs/tiny", "seed=1", *shared, *nothing, cwd=home)
        assert done.returncode == 0, done.stderr
        episodes = json.loads((folder / "returns.json").read_text())["episodes"]
        played.append([item["return"] for item in episodes])
    assert played[0] == played[1]


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


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("run.dir=nowhere",), "run.dir=nowhere: no such folder"),
        (("run.dir=runs/tiny", "checkpoint=5"), "no such checkpoint in"),
        (("run.dir=runs/tiny", "vidoe=gif"), "unknown key vidoe: did you mean video?"),
        (("run.dir=runs/tiny", "video=avi"), "video=avi: expected one of auto, mp4"),
        (("num_envs=2", "video_envs=3"), "video_envs=3: must be between 1 and 2"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(home: Path, overrides: Sequence[str], message: str):
    done = run_here("play", *overrides, cwd=home)
    assert done.code == 2, done.stderr
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_what_only_the_child_knows_is_bad_input_too(home: Path):
    done = play("run.dir=runs/tiny", "camera=nose", cwd=home)
    assert done.returncode == 2, done.stderr
    assert "camera=nose: unknown camera of ball_balance" in done.stderr
    assert done.stderr.count("\n") == 1
