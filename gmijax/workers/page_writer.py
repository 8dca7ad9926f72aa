"""Main of the page-writing child of `gmijax.play`, `page_writer.py PLAY_FOLDER`. No jax here.

Turns the trajectories of the filmed environments into a page that shows them in 3D in a browser.
The page holds the geometry, the motion and viser's viewer, and loads nothing from anywhere.
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco

from gmijax.runs.folder import PlayPaths, write_text
from gmijax.sim.trajectory import load_trajectory
from gmijax.viewer.recording import page


def main() -> int:
    """Writes the page; returns the exit code."""
    paths = PlayPaths(Path(sys.argv[1]))
    model = mujoco.MjModel.from_binary_path(str(paths.model))
    write_text(paths.html, page(model, load_trajectory(paths.trajectory)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
