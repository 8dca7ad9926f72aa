"""What a played checkpoint leaves, and how `gmijax.play` talks with its children. No jax here.

`<run>/play/<12-digit env steps>/{config.json,returns.json,video.mp4,video.gif,render.log}`, plus
`trajectory.npz` and `model.mjb`, which together can be filmed again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

EXIT_NO_GL: Final = 3
"""Exit code of the renderer where the OpenGL that it was told to use cannot be had."""


@dataclass(frozen=True)
class PlayPaths:
    """Files of one played checkpoint; it also has the files of a run with one GMI."""

    root: Path

    @property
    def returns(self) -> Path:
        """What every episode came to, and the statistics over them."""
        return self.root / "returns.json"

    @property
    def trajectory(self) -> Path:
        """`qpos` [L + 1, E, nq] of the shown environments, `lengths` [E], `control_dt_s`."""
        return self.root / "trajectory.npz"

    @property
    def model(self) -> Path:
        """The MuJoCo model of the trajectory, in MuJoCo's binary format."""
        return self.root / "model.mjb"

    @property
    def mp4(self) -> Path:
        """The film."""
        return self.root / "video.mp4"

    @property
    def gif(self) -> Path:
        """The film as an animated picture."""
        return self.root / "video.gif"

    @property
    def html(self) -> Path:
        """The first shown environment as a page that moves in 3D."""
        return self.root / "view.html"

    @property
    def page_log(self) -> Path:
        """What the writer of the page and its libraries complain about."""
        return self.root / "page.log"

    @property
    def render_log(self) -> Path:
        """What the renderer and its libraries complain about."""
        return self.root / "render.log"

    def results(self) -> tuple[Path, ...]:
        """All files that a new evaluation replaces."""
        watched = self.mp4, self.gif, self.html
        return self.returns, self.trajectory, self.model, *watched, self.render_log, self.page_log
