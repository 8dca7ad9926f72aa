"""Which headless OpenGL draws films here; each is tried in a fresh interpreter.

MuJoCo chooses it when it is imported, from MUJOCO_GL.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from typing import Final

from gmijax.errors import printable
from gmijax.machine.interpreter import command
from gmijax.runs.folder import EXIT_NO_GL

GL_VARIABLE: Final = "MUJOCO_GL"
NO_OPENGL: Final = "disable"
"""Its value for processes that draw nothing: where it names what is not installed, importing
mujoco fails."""


def opengls(*others: str) -> tuple[str, ...]:
    """What to try, in order: the user's MUJOCO_GL, then `others`."""
    return tuple(dict.fromkeys(filter(None, (os.environ.get(GL_VARIABLE), *others))))


def environment_with(gl: str) -> dict[str, str]:
    """This process's environment variables, for a child that is to draw with `gl`."""
    environment = {**os.environ, GL_VARIABLE: gl}
    # MuJoCo sets it to what fits MUJOCO_GL, and refuses any other value.
    environment.pop("PYOPENGL_PLATFORM", None)
    return environment


def first_opengl(tried: Sequence[str], timeout_s: float | None = None) -> tuple[str | None, str]:
    """The first of `tried` that draws here, None for none; and the message of the last one.

    One that takes longer than `timeout_s` for a picture does not draw.
    """
    message = ""
    for gl in tried:
        try:
            done = subprocess.run(
                command("gmijax.workers.play_film"),
                env=environment_with(gl),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=timeout_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            message = f"no picture within {timeout_s:g} s"
            continue
        if done.returncode == 0:
            return gl, ""
        message = next(iter(done.stderr.strip().splitlines()), f"exit code {done.returncode}")
    return None, printable(message)


def why_no_opengl() -> str | None:
    """Chooses OpenGL for this process, if mujoco is not imported yet; None if it can draw."""
    if "mujoco" in sys.modules:
        if os.environ.get(GL_VARIABLE) or os.environ.get("DISPLAY"):
            return None
        return "mujoco was imported before; set MUJOCO_GL=egl (or osmesa) before Python starts"
    tried = opengls("egl", "osmesa")
    gl, message = first_opengl(tried)
    if gl is None:
        return f"{what_is_missing(tried)}; the last one: {message}"
    os.environ[GL_VARIABLE] = gl
    os.environ.pop("PYOPENGL_PLATFORM", None)
    return None


def is_missing(exit_code: int) -> bool:
    """Whether a child of `gmijax.workers.play_film` ended for want of its OpenGL."""
    # A broken driver may end the process with a signal instead of an error. These two come from
    # outside: the user, a batch system, or the machine when it runs out of memory.
    sent = (-signal.SIGKILL, -signal.SIGTERM)
    return exit_code == EXIT_NO_GL or (exit_code < 0 and exit_code not in sent)


def what_is_missing(tried: Sequence[str]) -> str:
    """The message that none of them works, and what helps."""
    return (
        f"no headless OpenGL (EGL or OSMesa) is to be had, tried {', '.join(tried)}; "
        "install it with `apt-get install libegl1` or `apt-get install libosmesa6`"
    )
