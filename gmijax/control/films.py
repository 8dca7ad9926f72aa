"""Films of evaluations while training: found possible before it starts, made beside it.

The leader leaves the trajectory of an episode in the run folder (`gmijax.learning.episode_films`).
A process of the controller draws it, `gmijax.workers.film_writer`: no GMI waits for a film, and
GPUs are left alone where OSMesa, which draws on the CPU, is installed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from gmijax.config import TrainConfig
from gmijax.errors import ConfigError
from gmijax.machine.opengl import environment_with, first_opengl, opengls, what_is_missing
from gmijax.runs.folder import RunPaths
from gmijax.runs.names import by_steps
from gmijax.supervise.side_process import SideProcess

LAST_FILM_TIMEOUT_S: Final = 120.0
"""Longest wait for the film of the last evaluation when training is done."""

_GIVE_UP_S: Final = 5.0

FINISH: Final = b"finish"
"""Makes the process that renders film what is left before it ends."""


def find_opengl(config: TrainConfig) -> str | None:
    """The OpenGL that films of evaluations are drawn with, None if none are wanted.

    Raises:
      ConfigError: they are wanted, and there is none on this machine.
    """
    if not config.eval.video:
        return None
    tried = opengls("osmesa", "egl")
    gl, message = first_opengl(tried)
    if gl is not None:
        return gl
    raise ConfigError(
        f"eval.video={config.eval.video}: {what_is_missing(tried)}; the last one: {message}; "
        "without it, use eval.video=false"
    )


@contextmanager
def filmed(gl: str | None, run: RunPaths, say: Callable[[str], None]) -> Iterator[None]:
    """Evaluations are filmed while this is entered; failures are printed, not raised.

    When it ends well, what is left is filmed. When it ends with an error, nothing is waited for.

    Args:
      gl: see `find_opengl`; None: nothing is filmed.
      run: its folder.
      say: takes a line for the user.
    """
    if gl is None:
        yield
        return
    process = SideProcess(
        "gmijax.workers.film_writer",
        run.root,
        run.film_log,
        title="eval.video",
        lost="no more films are made",
        say=say,
        environment=environment_with(gl),
    )
    is_well = False
    try:
        yield
        is_well = True
    finally:
        if is_well:
            process.send(FINISH)
            if _waiting(run):
                say("filming the last evaluation")
        timeout_s = LAST_FILM_TIMEOUT_S if is_well else _GIVE_UP_S
        if not process.end(timeout_s):
            say(f"eval.video: the last film was given up after {timeout_s:g} s")
        if not _waiting(run):
            with suppress(OSError):
                run.filmed_model.unlink(missing_ok=True)


def _waiting(run: RunPaths) -> list[Path]:
    """Trajectories that are to be filmed."""
    return by_steps(run.videos, suffix=".npz")
