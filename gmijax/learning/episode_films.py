"""A GMI's part in films of evaluations: it writes trajectories that another process renders."""

from __future__ import annotations

import sys

from gmijax.config import TrainConfig
from gmijax.config.play import FILMED
from gmijax.errors import ConfigError
from gmijax.learning.episodes import Episodes
from gmijax.runs.folder import RunPaths
from gmijax.sim.interface import Env
from gmijax.sim.trajectory import save_model, save_trajectory


class EpisodeFilms:
    """Leaves episodes of evaluations in the run folder (see `gmijax.control.films`).

    Args:
      config: of the run.
      env: the environments in which evaluations are made.
      run: the run folder.

    Raises:
      ConfigError: the task has no model that could be drawn.
    """

    def __init__(self, config: TrainConfig, env: Env, run: RunPaths) -> None:
        if env.mj_model is None:
            raise ConfigError(
                f"eval.video={config.eval.video}: {env.spec.name} has no model that could be "
                "filmed; allowed: false"
            )
        assert config.eval.every is not None
        self._every = int(config.eval.video) * config.eval.every
        self._end = config.num_timesteps
        self._last_steps = 0
        self._spec, self._run = env.spec, run
        self._command = f"gmijax train env={config.env.label} seed={config.seed}"
        save_model(run.filmed_model, env.mj_model)

    def take(self, env_steps: int, episodes: Episodes) -> None:
        """Leaves some of `episodes`, evaluated after `env_steps`, if it is to be filmed."""
        is_due = env_steps // self._every > self._last_steps // self._every
        if not (is_due or env_steps >= self._end):
            return
        self._last_steps = env_steps
        trajectory = episodes.filmed(
            self._spec.control_dt_s,
            count=min(FILMED, episodes.qpos.shape[1]),
            title=f"{self._spec.name} after {env_steps:,} env steps",
            command=self._command,
        )
        try:
            save_trajectory(self._run.to_film(env_steps), trajectory)
        except OSError as error:
            # A full disk must not end what this only shows.
            sys.stderr.write(f"eval.video: no film after {env_steps} env steps ({error})\n")
