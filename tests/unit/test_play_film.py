"""Geometry and timing of films; nothing is drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gmijax.sim.captions import Captions
from gmijax.sim.trajectory import Trajectory, chosen, load_trajectory, save_trajectory
from gmijax.workers import play_film


@pytest.mark.parametrize(
    ("control_dt_s", "max_fps", "stride", "fps"),
    [
        (1 / 60, 30.0, 2, 30.0),  # exactly the limit: no rounding to a stride of 3
        (0.01, 30.0, 4, 25.0),
        (0.1, 30.0, 1, 10.0),  # slower than the limit: every step
        (1 / 30, 15.0, 2, 15.0),
    ],
)
def test_films_play_in_real_time(control_dt_s: float, max_fps: float, stride: int, fps: float):
    timing = play_film.real_time(control_dt_s, max_fps)
    assert timing.stride == stride
    assert timing.fps == pytest.approx(fps)


@pytest.mark.parametrize(
    ("picture_s", "fps", "length_s"),
    [(0.001, 15.0, 6.0), (0.035, 15.0, 3.33), (0.05, 12.5, 3.0), (0.5, 12.5, 3.0)],
)
def test_a_brief_film_is_shortened_before_it_stutters(
    picture_s: float, fps: float, length_s: float, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(play_film, "_picture_s", lambda *_: picture_s)
    whole = Trajectory(np.zeros((1001, 4, 1)), np.full(4, 1000), 0.01, (), ())
    brief, max_fps = play_film.brief(whole, PaintedStage(), 7.0)
    assert max_fps == pytest.approx(fps)
    assert 0.01 * (len(brief.qpos) - 1) == pytest.approx(length_s, abs=0.011)


@pytest.mark.parametrize(
    ("num_tiles", "grid"), [(1, (1, 1)), (2, (2, 1)), (3, (2, 2)), (5, (3, 2)), (9, (3, 3))]
)
def test_grid_is_as_square_as_possible(num_tiles: int, grid: tuple[int, int]):
    assert play_film.grid_of(num_tiles) == grid


def test_tiles_have_even_sides_and_fit_the_picture():
    assert play_film.tile_size(641, 481, (1, 1)) == (640, 480)
    assert play_film.tile_size(640, 480, (3, 2)) == (212, 240)


def test_tiles_are_laid_row_by_row_and_gaps_are_black():
    tiles = [np.full((2, 4, 3), value, np.uint8) for value in (10, 20, 30)]
    picture = play_film.compose(tiles, (2, 2))
    assert picture.shape == (4, 8, 3)
    assert picture[::2, ::4, 0].tolist() == [[10, 20], [30, 0]]


class PaintedStage:
    """Stands in for OpenGL: a picture is one pixel, as bright as the first position."""

    def picture(self, qpos: np.ndarray) -> np.ndarray:
        return np.full((1, 1, 3), qpos[0], np.uint8)


def test_environments_whose_episode_is_over_stand_still_and_dim():
    qpos = np.array([[[100.0], [200.0]]] * 5, np.float32)
    trajectory = Trajectory(qpos, np.array([4, 1]), 0.1)
    pictures = list(play_film.frames(trajectory, PaintedStage(), (2, 1), 1))
    assert [picture[0, :, 0].tolist() for picture in pictures] == [
        [100, 200],
        [100, 200],
        *[[100, 110]] * 3,  # 0.55 x 200
    ]


def test_trajectory_is_read_back(tmp_path: Path):
    qpos = np.arange(12, dtype=np.float32).reshape(3, 2, 2)
    lengths, texts = np.array([2, 1], np.int32), (("a", "b"), ("title", "$ c"))
    save_trajectory(tmp_path / "t.npz", Trajectory(qpos, lengths, 0.02, *texts))
    trajectory = load_trajectory(tmp_path / "t.npz")
    np.testing.assert_array_equal(trajectory.qpos, qpos)
    assert trajectory.lengths.tolist() == [2, 1]
    assert trajectory.control_dt_s == 0.02
    assert (trajectory.labels, trajectory.lines) == texts


def test_a_film_shows_quantiles_of_the_returns_and_names_the_median():
    returns = np.array([40.0, 10.0, 80.0, 30.0, 70.0, 20.0, 60.0, 50.0])
    lengths = np.array([4, 1, 8, 3, 7, 2, 6, 5], np.int32)
    qpos = np.broadcast_to(returns[:, None], (9, 8, 1)).astype(np.float32)
    shown = chosen(qpos, lengths, returns, 0.1, count=4, title="task", command="gmijax play")
    assert shown.qpos.shape == (9, 4, 1)
    assert shown.qpos[0, :, 0].tolist() == [20.0, 40.0, 60.0, 80.0]
    assert shown.lengths.tolist() == [2, 4, 6, 8]
    assert shown.labels[0] == "return 20 (rank 7 of 8)"
    assert shown.labels[-1] == "return 80 (rank 1 of 8)"
    assert shown.lines == ("task: median return 45 of 8 episodes", "$ gmijax play")
    [median] = chosen(qpos, lengths, returns, 0.1, count=1, title="t", command="c").qpos[0, :, 0]
    assert median in (40.0, 50.0)


def test_captions_lie_in_the_corner_and_below():
    captions = Captions(["return 1"], ["title", "$ command"])
    tile = np.full((240, 320, 3), 200, np.uint8)
    labelled = captions.label(0, tile)
    assert labelled.shape == tile.shape
    assert labelled[:18].min() < 100 < 200 == labelled[18:].min()
    assert tile.min() == 200
    below = captions.below(tile, 1.5)
    assert below.shape == (280, 320, 3)
    assert (captions.below(tile, 2.5) != below).any()
    assert captions.label(1, tile) is tile  # An environment of which nothing is known.
    small = tile[:60, :80]
    assert captions.label(0, small) is small
    assert captions.below(small, 0.0) is small
