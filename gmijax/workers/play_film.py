"""Draws films. Main of the filming child of `gmijax.play`. No jax here.

`play_film.py PLAY_FOLDER [S]` films a played checkpoint, briefly if it is to take S seconds;
without a folder its exit code shows whether it could.

Draws a trajectory with MuJoCo, without a display, through the OpenGL that MUJOCO_GL names. That
choice is made when mujoco is imported and cannot be changed after, hence a child of its own.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import imageio_ffmpeg
import numpy as np

from gmijax.config import PlayConfig
from gmijax.config.schema import from_dict
from gmijax.runs.folder import EXIT_NO_GL, PlayPaths, RunPaths, read_json
from gmijax.sim.captions import Captions
from gmijax.sim.stage import Image, Stage
from gmijax.sim.trajectory import Trajectory, load_trajectory

MP4_MAX_FPS, GIF_MAX_FPS = 30.0, 15.0
BRIEF_S, BRIEF_LEAST_S = 6.0, 3.0
BRIEF_FPS, BRIEF_LEAST_FPS = 15.0, 12.5
"""Of a brief film: its length and its frames a second, and the least of both. It is shortened
first: with fewer frames a second nothing is seen to move."""

_TRIED = 3
"""Pictures that are timed: another process may use the machine during one of them."""

_H264_CRF = "20"
_GIF_MAX_WIDTH = 480
# GIF packs badly: a smaller picture, one palette for the whole film, chosen for what moves, and
# a dither that stands still from frame to frame.
_GIF_FILTER = (
    f"scale=w='min(iw,{_GIF_MAX_WIDTH})':h=-2:flags=area,split[a][b];"
    "[a]palettegen=max_colors=128:stats_mode=diff[p];"
    "[b][p]paletteuse=dither=bayer:bayer_scale=5:diff_mode=rectangle"
)
_OUTPUT: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        ".mp4": {
            "codec": "libx264",
            "output_params": ["-crf", _H264_CRF, "-movflags", "+faststart"],
        },
        ".gif": {
            "codec": "gif",
            "pix_fmt_out": "pal8",
            "output_params": ["-vf", _GIF_FILTER, "-loop", "0"],
        },
    }
)
_ENDED_BRIGHTNESS = 0.55

Writer: TypeAlias = Generator[None, Image | None, None]


class Timing(NamedTuple):
    """Which steps of a trajectory become frames, so that a film plays in real time.

    Attributes:
      stride: steps per frame.
      fps: frames per second.
    """

    stride: int
    fps: float


def main(arguments: Sequence[str]) -> int:
    """Films the folder's trajectory; returns the exit code."""
    if not arguments:
        return EXIT_NO_GL if _stage(None, (64, 64), None) is None else 0
    folder, *limit = Path(arguments[0]), *map(float, arguments[1:])
    config = from_dict(PlayConfig, read_json(RunPaths(folder).config))
    paths = PlayPaths(folder)
    grid = grid_of(config.num_filmed)
    stage = _stage(paths.model, tile_size(config.width, config.height, grid), config.camera)
    if stage is None:
        return EXIT_NO_GL
    made = {"gif": (paths.gif,), "both": (paths.mp4, paths.gif)}.get(config.video, (paths.mp4,))
    trajectory = load_trajectory(paths.trajectory)
    max_fps = MP4_MAX_FPS
    if limit:
        trajectory, max_fps = brief(trajectory, stage, limit[0])
    film(made, trajectory, stage, grid, max_fps)
    return 0


def _stage(model: Path | None, size: tuple[int, int], camera: str | None) -> Stage | None:
    """See `Stage`; None where OpenGL cannot be had, and why on standard error."""
    try:
        # Whatever goes wrong up to the first picture is the fault of this OpenGL: a library
        # that is missing shows as any of half a dozen errors, at import or later.
        return Stage(model, size, camera)
    except Exception as error:
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        return None


def real_time(control_dt_s: float, max_fps: float) -> Timing:
    """The finest timing with at most `max_fps` frames per second.

    Examples:
      >>> real_time(0.01, 30.0)
      Timing(stride=4, fps=25.0)
    """
    # Without the margin 60 steps a second at 30 frames could round up to a stride of 3.
    stride = max(1, math.ceil(1.0 / (control_dt_s * max_fps) - 1e-6))
    return Timing(stride, 1.0 / (control_dt_s * stride))


def grid_of(num_tiles: int) -> tuple[int, int]:
    """Columns and rows of a grid of at least `num_tiles`, as square as possible."""
    columns = math.ceil(math.sqrt(num_tiles))
    return columns, math.ceil(num_tiles / columns)


def tile_size(width: int, height: int, grid: tuple[int, int]) -> tuple[int, int]:
    """Width and height of a tile, even numbers: H.264 takes no others."""
    columns, rows = grid
    return max(2, width // columns // 2 * 2), max(2, height // rows // 2 * 2)


def compose(tiles: list[Image], grid: tuple[int, int]) -> Image:
    """The tiles side by side, row by row; cells without a tile are black."""
    columns, rows = grid
    tiles = tiles + [np.zeros_like(tiles[0])] * (columns * rows - len(tiles))
    strips = [np.concatenate(tiles[row * columns : (row + 1) * columns], 1) for row in range(rows)]
    return np.concatenate(strips, 0)


def frames(
    trajectory: Trajectory, stage: Stage, grid: tuple[int, int], stride: int
) -> Iterator[Image]:
    """Every `stride`-th step as a picture; an environment whose episode is over is dimmed."""
    captions, last = Captions(trajectory.labels, trajectory.lines), dict[int, Image]()
    for step in range(0, len(trajectory.qpos), stride):
        tiles: list[Image] = []
        for index, length in enumerate(trajectory.lengths):
            if index not in last:
                picture = stage.picture(trajectory.qpos[min(step, length), index])
                if step > length:
                    picture = (picture * _ENDED_BRIGHTNESS).astype(np.uint8)
                picture = captions.label(index, picture)
                if step > length:
                    last[index] = picture
                tiles.append(picture)
            else:
                tiles.append(last[index])
        yield captions.below(compose(tiles, grid), step * trajectory.control_dt_s)


def brief(trajectory: Trajectory, stage: Stage, seconds: float) -> tuple[Trajectory, float]:
    """The beginning of the episodes, and at most how many frames of it a second.

    So many that they are drawn in about `seconds`, if that is enough for something to see.
    """
    picture_s = min(_picture_s(trajectory, stage) for _ in range(_TRIED))
    frames = seconds / (picture_s * len(trajectory.lengths))
    max_fps = min(BRIEF_FPS, max(BRIEF_LEAST_FPS, frames / BRIEF_LEAST_S))
    length_s = min(BRIEF_S, max(BRIEF_LEAST_S, frames / max_fps))
    steps = int(length_s / trajectory.control_dt_s)
    return trajectory._replace(qpos=trajectory.qpos[: steps + 1]), max_fps


def _picture_s(trajectory: Trajectory, stage: Stage) -> float:
    started_s = time.perf_counter()
    stage.picture(trajectory.qpos[0, 0])
    return time.perf_counter() - started_s


def film(
    made: Sequence[Path],
    trajectory: Trajectory,
    stage: Stage,
    grid: tuple[int, int],
    max_fps: float = MP4_MAX_FPS,
) -> None:
    """Writes the film to each of `made`, .mp4 or .gif; every picture is drawn once."""
    mp4 = any(path.suffix == ".mp4" for path in made)
    timing = real_time(trajectory.control_dt_s, min(max_fps, MP4_MAX_FPS if mp4 else GIF_MAX_FPS))
    slower = real_time(1.0 / timing.fps, GIF_MAX_FPS)
    drawn = frames(trajectory, stage, grid, timing.stride)
    first = next(drawn)
    with ExitStack() as stack:
        writers: list[tuple[Writer, int]] = []
        for path in made:
            every, fps = (1, timing.fps) if path.suffix == ".mp4" else (slower.stride, slower.fps)
            writers.append((stack.enter_context(_writer(path, first, fps)), every))
        for number, frame in enumerate(chain([first], drawn)):
            for writer, every in writers:
                if number % every == 0:
                    writer.send(np.ascontiguousarray(frame))


@contextmanager
def _writer(path: Path, first: Image, fps: float) -> Iterator[Writer]:
    """Pictures sent to it become a film at `path`, which appears when it is complete."""
    partial = path.with_name(f".{path.name}")
    writer: Writer = imageio_ffmpeg.write_frames(
        str(partial),
        (first.shape[1], first.shape[0]),
        macro_block_size=1,
        **{**_OUTPUT[path.suffix], "fps": fps, "quality": None},
    )
    writer.send(None)
    try:
        yield writer
    finally:
        writer.close()
    os.replace(partial, path)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
