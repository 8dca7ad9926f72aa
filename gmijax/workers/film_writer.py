"""Main of the process that films the evaluations of a run: `film_writer.py RUN_DIR`. No jax.

A process of its own, so that nothing of it can end or delay training. It draws one film at a time,
of what the leader has left in `<run>/videos/`. If drawing is slower than evaluations come, only
the newest of those that wait is filmed. Its standard input ends when the job does: it films what
is left if it was asked to finish, and else ends at once.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from typing import Final

from gmijax.control.films import FINISH
from gmijax.runs.folder import RunPaths
from gmijax.runs.names import by_steps
from gmijax.sim.stage import Stage
from gmijax.sim.trajectory import load_trajectory
from gmijax.supervise.side_process import exit_code_beside
from gmijax.workers.play_film import film, grid_of, tile_size

_SIZE: Final = (640, 480)
_POLL_S: Final = 1.0
_NICE: Final = 10
"""Training goes first where there are not enough cores for both."""


def main(root: Path) -> int:
    """Returns the exit code: 0, or 1 with one line on standard error."""
    os.nice(_NICE)
    is_over = threading.Event()
    threading.Thread(target=_listen, args=(is_over,), daemon=True).start()
    return exit_code_beside(lambda: follow(RunPaths(root), is_over))


def follow(run: RunPaths, is_over: threading.Event) -> None:
    """Films trajectories as they come, until it is over and none is left."""
    for unfinished in by_steps(run.videos, prefix=".", suffix=".mp4"):
        unfinished.unlink()
    stage: Stage | None = None
    while True:
        # Asked first: what was left before the end is seen then.
        is_last = is_over.is_set()
        *passed_over, newest = (None, *by_steps(run.videos, suffix=".npz"))
        for path in filter(None, passed_over):
            path.unlink()
        if newest is not None:
            trajectory = load_trajectory(newest)
            grid = grid_of(len(trajectory.lengths))
            stage = stage or Stage(run.filmed_model, tile_size(*_SIZE, grid), None)
            film((newest.with_suffix(".mp4"),), trajectory, stage, grid)
            newest.unlink()
        elif is_last:
            break
        else:
            is_over.wait(_POLL_S)


def _listen(is_over: threading.Event) -> None:
    """Waits for the end of the job."""
    received = b""
    # Not by `sys.stdin`, whose lock Python needs when it ends.
    while part := os.read(sys.stdin.fileno(), len(FINISH)):
        received += part
    if received != FINISH:
        os._exit(0)  # Also in the middle of a film.
    is_over.set()


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
