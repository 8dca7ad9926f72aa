"""Pictures of played episodes: a film and a page, each made by a child of its own."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import IO

from rich.console import Console

from gmijax.config import PlayConfig
from gmijax.control.console import doing, nearby
from gmijax.errors import GmijaxError
from gmijax.machine.interpreter import command
from gmijax.machine.opengl import (
    NO_OPENGL,
    environment_with,
    is_missing,
    opengls,
    what_is_missing,
)
from gmijax.runs.folder import EXIT_NO_GL, PlayPaths
from gmijax.supervise.failures import last_line, signal_name
from gmijax.viewer.installed import missing


def write_page(config: PlayConfig, paths: PlayPaths, console: Console) -> None:
    """Writes the page in a child of its own."""
    if missing():
        return
    with doing(console, "writing the page"), paths.page_log.open("wb") as log:
        exit_code = run_child(
            "gmijax.workers.page_writer", paths, environment_with(NO_OPENGL), log
        )
    if exit_code == 0:
        console.print(f"page: {nearby(paths.html)}")
        return
    reason = f"no page: {last_line(paths.page_log)} (log: {nearby(paths.page_log)})"
    if config.html == "on":
        raise GmijaxError(f"{reason}; the returns were evaluated")
    console.print(reason)


def film(
    config: PlayConfig,
    paths: PlayPaths,
    camera: str,
    console: Console,
    seconds: float | None = None,
) -> None:
    """Films with the first OpenGL that works; each is tried in a fresh interpreter.

    Args:
      config: what is filmed.
      paths: where the trajectory is, and the film goes.
      camera: a text about the camera.
      console: for the user.
      seconds: a brief film, which takes about so long to draw; None: all of it.

    Raises:
      GmijaxError: there is no film, and `config` asks for one.
    """
    tried = opengls("egl", "osmesa")
    exit_code = EXIT_NO_GL
    for gl in tried:
        with doing(console, f"filming with {gl}"):
            exit_code = render(gl, paths, seconds)
        if exit_code == 0:
            for video in filter(Path.exists, (paths.mp4, paths.gif)):
                console.print(f"video: {nearby(video)}")
            console.print(f"filmed by {camera}")
            return
        if not is_missing(exit_code):
            raise GmijaxError(f"no video: {_why(exit_code, paths)}; the returns were evaluated")
    reason = (
        f"no video: {what_is_missing(tried)}; "
        f"the last one: {_why(exit_code, paths)}; the returns were evaluated"
    )
    if config.video != "auto":
        raise GmijaxError(reason)
    console.print(reason)


def _why(exit_code: int, paths: PlayPaths) -> str:
    ended = f"the renderer was ended by {signal_name(-exit_code)}" if exit_code < 0 else ""
    message = last_line(paths.render_log)
    return f"{': '.join(filter(None, (ended, message)))} (log: {nearby(paths.render_log)})"


def render(gl: str, paths: PlayPaths, seconds: float | None = None) -> int:
    """Films in a process with this OpenGL (a value of `MUJOCO_GL`); returns its exit code."""
    own = () if seconds is None else (str(seconds),)
    with paths.render_log.open("ab") as log:
        return run_child("gmijax.workers.play_film", paths, environment_with(gl), log, *own)


def run_child(
    module: str,
    paths: PlayPaths,
    environment: Mapping[str, str],
    log: IO[bytes],
    *arguments: str,
) -> int:
    """Runs a module on the folder of a played checkpoint; returns its exit code."""
    return subprocess.run(
        command(module, str(paths.root), *arguments),
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        check=False,
    ).returncode
