"""Plays a policy that comes with gmijax, in plain MuJoCo: no run, no jax, nothing is compiled.

A child does it, `gmijax.workers.plain_playback`. No jax and no mujoco here.
"""

from __future__ import annotations

from typing import Final

from gmijax.config import PlayConfig
from gmijax.deploy.output import prepare_output
from gmijax.deploy.pictures import run_child
from gmijax.errors import ConfigError, GmijaxError
from gmijax.machine.opengl import NO_OPENGL, environment_with
from gmijax.player.shipped import require_alone, require_shipped
from gmijax.runs.folder import RUNS, PlayPaths
from gmijax.runs.names import nearby
from gmijax.supervise.failures import last_line

SHIPPED: Final = "shipped"
"""Value of `checkpoint`."""


def checked(config: PlayConfig) -> PlayConfig:
    """The configuration.

    Raises:
      ConfigError: no policy of this task is shipped, or it cannot be played so.
    """
    require_alone("run.dir", config.run.dir)  # A run has its own task.
    require_shipped(config.run.env)
    require_alone("deterministic", config.deterministic, True)
    require_alone("randomize", config.randomize, "off")
    require_alone("physics.impl", config.physics.impl, "auto")
    require_alone("walking_envs", config.walking_envs or None)
    return config


def folder_of(config: PlayConfig) -> PlayPaths:
    """`runs/shipped/<task>`, with the configuration and nothing of an earlier call.

    Raises:
      ConfigError: as `prepare_output`.
    """
    paths = PlayPaths(RUNS / SHIPPED / str(config.run.env))
    prepare_output(paths.root, config, paths.results())
    return PlayPaths(paths.root.resolve())


def play(paths: PlayPaths, seconds: float | None = None) -> None:
    """Plays; with `seconds` only about so long, but as many episodes as a film shows.

    Raises:
      ConfigError: the configuration asks for what the task does not have.
      GmijaxError: it failed.
    """
    own = () if seconds is None else (str(seconds),)
    log = paths.root / "stderr.log"
    with log.open("wb") as output:
        environment = environment_with(NO_OPENGL)
        code = run_child("gmijax.workers.plain_playback", paths, environment, output, *own)
    if code == 2:
        raise ConfigError(last_line(log))
    if code:
        raise GmijaxError(
            f"playing failed (exit code {code}): {last_line(log)} (log: {nearby(log)})"
        )
    log.unlink()
