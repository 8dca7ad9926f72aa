"""Evaluation while training: whole episodes with the policy as it is, run by all GMIs that train.

The environments are the evaluations' own, and so are their random keys: episode j of an evaluation
is environment 2^30 + j of the job. So training continues as if there were no evaluations, all
evaluations of a run begin in the same states, and how many GMIs share the episodes makes no
difference.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.collectives.interface import Communicator
from gmijax.config import TrainConfig
from gmijax.learning.episode_films import EpisodeFilms
from gmijax.learning.episodes import EpisodeOptions, EpisodeRunner, Episodes
from gmijax.learning.learner import Learner, TrainState
from gmijax.runs.folder import RunPaths
from gmijax.sim.interface import Env
from gmijax.sim.randomize import make_envs
from gmijax.sim.trajectory import MOST_RECORDED

FIRST_EVAL_ENV = 2**30
"""Number of the first environment of an evaluation: no training has as many."""


class Evaluation(NamedTuple):
    """Outcome of an evaluation.

    Attributes:
      started_s: when it began.
      wall_s: seconds that it took.
      metrics: for the line of metrics; empty if it was given up because the job is to end.
      is_best: whether its mean return is the best of the run so far.
    """

    started_s: float
    wall_s: float
    metrics: dict[str, float]
    is_best: bool

    @property
    def mean_return(self) -> float | None:
        """Of all episodes; None if it was given up."""
        return self.metrics.get("eval/return")


def evaluation_envs(config: TrainConfig, rank: int, world_size: int) -> Env:
    """The environments in which the GMI with this rank evaluates.

    As many on each, so that all run the same program: there may be more than episodes. Without a
    curriculum, so that evaluations can be compared.
    """
    num_envs = -(-config.eval.episodes // world_size)
    return make_envs(
        dataclasses.replace(config.env, curriculum="off"),
        config.physics.impl,
        seed=config.seed,
        first_env=FIRST_EVAL_ENV + rank * num_envs,
        num_envs=num_envs,
    )


class Evaluator:
    """One GMI's part of the evaluations; all that train must use it in the same way.

    Args:
      env: see `evaluation_envs`.
      learner: the networks.
      config: of the run.
      comm: among the GMIs that train.
      run: the run folder, in which the leader leaves what is to be filmed.

    Attributes:
      best: the best mean return of the run so far, -inf while there is none.
      wall_s: seconds of all evaluations together.

    Raises:
      ConfigError: the task cannot be filmed, and is to be.
    """

    def __init__(
        self, env: Env, learner: Learner, config: TrainConfig, comm: Communicator, run: RunPaths
    ) -> None:
        assert config.eval.every is not None
        self._every, self._num_episodes = config.eval.every, config.eval.episodes
        self._comm = comm
        num_envs = -(-self._num_episodes // comm.world_size)
        first = comm.rank * num_envs
        self._num_own = min(max(0, self._num_episodes - first), num_envs)
        options = EpisodeOptions(
            num_envs=num_envs,
            num_shown=self._num_recorded(config),
            seed=config.seed,
            deterministic=config.eval.deterministic,
            max_steps=None,
            first_env=FIRST_EVAL_ENV + first,
            key="eval.episodes",
        )
        self._runner = EpisodeRunner(env, learner, options)
        self._films: EpisodeFilms | None = None
        if config.eval.video and comm.rank == 0:
            self._films = EpisodeFilms(config, env, run)
        self.best = -math.inf
        self.wall_s = 0.0

    def _num_recorded(self, config: TrainConfig) -> int:
        """Of how many episodes the positions are kept."""
        if not config.eval.video or self._comm.rank > 0:
            return 1  # The least that a runner keeps.
        return max(1, min(self._num_own, MOST_RECORDED))

    def trace(self, state: TrainState) -> None:
        """Traces the programs; `state` has the shapes of those that will be evaluated."""
        self._runner.trace(state)

    def compile(self) -> None:
        """Compiles what was traced."""
        self._runner.compile()

    def is_due(self, env_steps: int, last_steps: int) -> bool:
        """Whether to evaluate after `env_steps`, in an iteration that began with `last_steps`."""
        return env_steps // self._every > last_steps // self._every

    def run(
        self,
        state: TrainState,
        env_steps: int,
        beat: Callable[[], None],
        must_stop: Callable[[], bool],
    ) -> Evaluation:
        """Evaluates; collective.

        Args:
          state: what to evaluate; equal on all GMIs.
          env_steps: of the whole job, of which `state` is the outcome.
          beat: called after every part of the episodes.
          must_stop: whether the job is to end; if so on any GMI, the evaluation is given up.

        Raises:
          PeerLost, CollectiveTimeout: see `Communicator.all_gather`.
        """
        started = time.monotonic()
        is_given_up = False

        def go_on(_: int, running: bool) -> bool:
            # Together after every part: no GMI waits long for those with longer episodes.
            nonlocal is_given_up
            beat()
            mine = np.array([running, must_stop()], np.float32)
            some_run, some_stop = self._comm.all_gather(mine).sum(axis=0)
            is_given_up = bool(some_stop)
            return bool(some_run) and not is_given_up

        episodes = self._runner.run(state, go_on)
        metrics = {} if is_given_up else self._metrics(episodes)
        is_best = metrics.get("eval/return", -math.inf) > self.best
        if is_best:
            self.best = metrics["eval/return"]
        if self._films is not None and not is_given_up:
            self._films.take(env_steps, episodes)
        wall_s = time.monotonic() - started
        self.wall_s += wall_s
        if metrics:
            metrics["time/eval_s"] = wall_s
        return Evaluation(started, wall_s, metrics, is_best)

    def _metrics(self, episodes: Episodes) -> dict[str, float]:
        columns = {
            **{f"eval/{name}": values for name, values in episodes.metrics.items()},
            "eval/return": episodes.returns,
            "eval/length": episodes.lengths,
        }
        means = dict(zip(columns, self._means(list(columns.values())), strict=True))
        off = episodes.returns.astype(np.float64) - means["eval/return"]
        [variance] = self._means([off**2])
        return {**means, "eval/return_std": math.sqrt(variance)}

    def _means(self, columns: list[npt.NDArray[np.generic]]) -> list[float]:
        """The mean over all episodes of each column [N]."""
        own = [values[: self._num_own].sum(dtype=np.float64) for values in columns]
        sums = self._comm.all_gather(np.array(own, np.float32))
        return [float(total) / self._num_episodes for total in sums.sum(axis=0, dtype=np.float64)]
