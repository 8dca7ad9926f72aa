"""Pictures of played episodes: a film and a page, each made by a child of its own. No jax here."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Final

from rich.console import Console

from gmijax.config import PlayConfig
from gmijax.errors import GmijaxError
from gmijax.runs.folder import EXIT_NO_GL, PlayPaths
from gmijax.supervise.failures import last_line, signal_name

_GL: Final = "MUJOCO_GL"
_FALLBACK_GLS: Final = ("egl", "osmesa")


def write_page(config: PlayConfig, paths: PlayPaths, console: Console) -> None:
    """Writes the page in a child of its own: Brax's libraries may fail as they like."""
    if not has_brax():
        return
    # A page is quickly made, and the GPU may be training.
    environment = {"PJRT_NPROC": "4", **os.environ, "JAX_PLATFORMS": "cpu"}
    with console.status("writing the page"), paths.page_log.open("wb") as log:
        exit_code = _child("gmijax.sim.page", paths, environment, log)
    if exit_code == 0:
        console.print(f"page: {paths.html}")
        return
    reason = f"no page: {last_line(paths.page_log)} (log: {paths.page_log})"
    if config.html == "on":
        raise GmijaxError(f"{reason}; the returns were evaluated")
    console.print(reason)


def has_brax() -> bool:
    """Whether a page can be written."""
    return importlib.util.find_spec("brax") is not None


def film(config: PlayConfig, paths: PlayPaths, console: Console) -> None:
    """Films with the first OpenGL that works; each is tried in a fresh interpreter."""
    users = os.environ.get(_GL)
    tried = tuple(dict.fromkeys((users, *_FALLBACK_GLS) if users else _FALLBACK_GLS))
    exit_code = EXIT_NO_GL
    for gl in tried:
        with console.status(f"filming with {gl}"):
            exit_code = _render(gl, paths)
        if exit_code == 0:
            for video in filter(Path.exists, (paths.mp4, paths.gif)):
                console.print(f"video: {video}")
            return
        if not _is_for_want_of_gl(exit_code):
            raise GmijaxError(f"no video: {_why(exit_code, paths)}; the returns were evaluated")
    reason = (
        f"no video: no headless OpenGL (EGL or OSMesa) is to be had, tried {', '.join(tried)}; "
        "install it with `apt-get install libegl1` or `apt-get install libosmesa6`; "
        f"the last one: {_why(exit_code, paths)}; the returns were evaluated"
    )
    if config.video != "auto":
        raise GmijaxError(reason)
    console.print(reason)


def _is_for_want_of_gl(exit_code: int) -> bool:
    # A broken driver may end the process with a signal instead of an error. These two come from
    # somebody else: the user, a batch system, or the machine when it runs out of memory.
    sent = (-signal.SIGKILL, -signal.SIGTERM)
    return exit_code == EXIT_NO_GL or (exit_code < 0 and exit_code not in sent)


def _why(exit_code: int, paths: PlayPaths) -> str:
    ended = f"the renderer was ended by {signal_name(-exit_code)}" if exit_code < 0 else ""
    said = last_line(paths.render_log)
    return f"{': '.join(filter(None, (ended, said)))} (log: {paths.render_log})"


def _render(gl: str, paths: PlayPaths) -> int:
    environment = {**os.environ, _GL: gl}
    # MuJoCo sets it to what fits MUJOCO_GL, and refuses any other value.
    environment.pop("PYOPENGL_PLATFORM", None)
    with paths.render_log.open("ab") as log:
        return _child("gmijax.sim.render", paths, environment, log)


def _child(module: str, paths: PlayPaths, environment: Mapping[str, str], log: IO[bytes]) -> int:
    """Runs a module on the folder of a played checkpoint; returns its exit code."""
    return subprocess.run(
        [sys.executable, "-m", module, str(paths.root)],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        check=False,
    ).returncode
