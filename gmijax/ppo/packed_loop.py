"""The training loop of a GMI that makes several runs in one program.

They differ in seed and learning rate alone. Their learners and environments are stacked along a
leading axis [K], and `jax.vmap` makes one program of their K iterations, whose kernels are K times
as large. Each run has its own folder, with its metrics, checkpoints and result.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from gmijax.collectives.interface import Peers, Step, TracedStep
from gmijax.config import PpoConfig, TrainConfig
from gmijax.devices import describe_device
from gmijax.errors import NonFiniteError, ReportedError
from gmijax.learning.checkpoint import (
    checkpoint_meta,
    finish_checkpoint,
    on_host,
    require_finite,
    save_envs,
    save_episodes,
    save_learner,
)
from gmijax.learning.episode_window import Standing
from gmijax.learning.learner import Learner, TrainState, make_learner
from gmijax.learning.policy_file import save_policy
from gmijax.learning.report_thread import ReportThread
from gmijax.learning.start import first_envs, first_state, first_window
from gmijax.learning.training_log import TrainingLog
from gmijax.ppo.loop import report, warm_up
from gmijax.ppo.ppo import IterationMetrics, iterate
from gmijax.runs.folder import RunPaths, write_json
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.supervise.child import ChildLink
from gmijax.types import PyTree


class Member:
    """One of the runs.

    Attributes:
      config: of the run.
      run: its run folder.
      error: why it has ended before the others, None while it goes on.
    """

    def __init__(self, config: TrainConfig, run: RunPaths) -> None:
        self.config, self.run = config, run
        self.error: NonFiniteError | None = None
        self._log: TrainingLog | None = None
        self._checkpoint: Path | None = None

    @property
    def log(self) -> TrainingLog:
        """Its lines of metrics."""
        assert self._log is not None
        return self._log

    def open_log(self, env_steps: int, episode_length: int) -> None:
        """Before the first line."""
        config = self.config
        window = first_window(config, episode_length * config.envs_per_gmi, 0, 1)
        self._log = TrainingLog.open(config.env.label, self.run, env_steps, window)

    def report(self, env_steps: int, metrics: IterationMetrics) -> None:
        """Writes a line; if its numbers are not finite, the run has failed."""
        try:
            report(self.log, env_steps, metrics, {})
        except NonFiniteError as error:
            self._fail(error)

    def save(
        self, env_steps: int, state: TrainState, envs: BatchState, episodes: dict[str, Any]
    ) -> None:
        """Writes a checkpoint, without its name; if numbers are not finite, the run fails."""
        try:
            require_finite(state.params, self.config.env.label, env_steps)
        except NonFiniteError as error:
            self._fail(error)
            return
        save_envs(self.run, env_steps, 0, envs)
        save_learner(self.run, env_steps, state)
        save_policy(self.run, env_steps, self.config.env, self.config.algo, state)
        save_episodes(self.run, env_steps, self.config, episodes)

    def name_checkpoint(self, env_steps: int, standing: Standing) -> None:
        """After `save`."""
        meta = checkpoint_meta(self.config, env_steps, 1, standing)
        self._checkpoint = finish_checkpoint(self.run, meta, self.config.run.keep_checkpoints)

    def result(self, steps_per_iteration: int) -> dict[str, Any]:
        """Its part of the outcome."""
        line_s = self.log.line_s
        steady = line_s[1:] or line_s  # As in `TrainingLoop`.
        return {
            "step_per_s_train": steps_per_iteration / statistics.median(steady)
            if steady
            else None,
            "final_return": self.log.last_return,
            "overflow_steps": self.log.overflows.steps,
            "checkpoint": str(self._checkpoint) if self._checkpoint else None,
        }

    def _fail(self, error: NonFiniteError) -> None:
        self.error = error
        said = ReportedError(type(error).__name__, str(error), str(error), ())
        write_json(self.run.gmi(0).error, said._asdict())


class PackedLoop:
    """K runs.

    Args:
      members: the runs, from the same step on.
      env: the environments, made for all of them together.
      program: makes the program of a step; see `Reducer.program`.
      link: to the controller.
    """

    def __init__(
        self,
        members: Sequence[Member],
        env: BatchedEnv,
        program: Callable[[Step], TracedStep],
        link: ChildLink,
    ) -> None:
        self._members, self._env, self._link = list(members), env, link
        self._config = config = members[0].config
        assert isinstance(config.algo, PpoConfig)
        self._warms_up = config.algo.warmup_unroll and config.run.resume is None
        self._learner = make_learner(env.spec, config.algo)
        self._iteration = program(partial(_iterate_all, env, self._learner))
        self._steps_per_iteration = config.envs_per_gmi * config.algo.unroll_length
        self._env_steps = self._iterations = 0
        self._saver = ReportThread(self._save_all)

    def run(self) -> None:
        """Trains until `num_timesteps` or until the controller asks for an end.

        Runs whose numbers are no longer finite end alone, with an `error.json`; others with
        a `result.json`.
        """
        started_s = time.monotonic()
        self._link.end_part("environments")
        states, envs = self._first()
        self._link.end_part("states")
        self._iteration.trace(self._env.model, states, envs)
        self._link.begin_compiling()
        self._iteration.compile()
        self._link.end_part("compiling")
        compile_s = time.monotonic() - started_s - self._link.start_s["waiting"]
        self._link.beat("ready", 0)
        if self._warms_up:
            states, envs = warm_up(self._iteration, states, envs)
        for member in self._members:
            member.open_log(self._env_steps, self._env.spec.episode_length)
        first_steps, started_s = self._env_steps, time.monotonic()
        stopped = self._train(states, envs)
        wall_s = time.monotonic() - started_s
        shared = {
            "status": "stopped" if stopped else "completed",
            "env_steps": self._env_steps,
            "iterations": self._iterations,
            "train_wall_s": wall_s,
            "compile_s": compile_s,
            "env_steps_per_s": (self._env_steps - first_steps) / wall_s,
            "device": describe_device(),
        }
        for member in self._going_on():
            first_update_s = next(iter(member.log.line_s), None)
            start_s = self._link.start_s | {"first_update": first_update_s}
            own = member.result(self._steps_per_iteration)
            write_json(member.run.gmi(0).result, {**shared, "start_s": start_s, **own})

    def _going_on(self) -> list[Member]:
        return [member for member in self._members if member.error is None]

    def _first(self) -> tuple[TrainState, BatchState]:
        states: list[TrainState] = []
        envs: list[BatchState] = []
        for member in self._members:
            config = member.config
            state, self._env_steps = first_state(self._learner, self._env.spec.obs_size, config)
            states.append(state)
            envs.append(first_envs(self._env, config, 0, gmi=0, num_gmis=1))
        return _stack(states), _stack(envs)

    def _train(self, states: TrainState, envs: BatchState) -> bool:
        """Returns whether it was asked to stop."""
        thread = ReportThread(self._report)
        try:
            return self._loop(states, envs, thread)
        finally:
            thread.stop()
            self._saver.stop()
            for member in self._members:
                member.log.close()

    def _loop(self, states: TrainState, envs: BatchState, thread: ReportThread) -> bool:
        every, stop = self._config.run.checkpoint_every, False
        while self._env_steps < self._config.num_timesteps and not stop and self._going_on():
            states, envs, metrics = self._iteration(states, envs)
            self._env_steps += self._steps_per_iteration
            self._iterations += 1
            thread.report(self._env_steps, metrics)
            self._link.beat("running", self._env_steps // self._steps_per_iteration)
            stop = self._link.stop_requested
            is_last = stop or self._env_steps >= self._config.num_timesteps
            if every and self._iterations % every == 0 and not is_last:
                self._save(states, envs, thread)
        self._save(states, envs, thread)
        self._saver.wait()
        return stop

    def _report(self, env_steps: int, metrics: IterationMetrics) -> None:
        """Waits for the iteration that ended at `env_steps`, and writes a line for each."""
        host = jax.device_get(metrics)
        for number, member in enumerate(self._members):
            if member.error is None:
                member.report(env_steps, jax.tree.map(lambda x, k=number: x[k], host))

    def _save(self, states: TrainState, envs: BatchState, thread: ReportThread) -> None:
        """Begins to save; training goes on meanwhile."""
        self._iteration.wait()
        thread.wait()  # A resumed run goes on from the lines up to its checkpoint.
        logs = [member.log for member in self._members]
        episodes, standings = zip(*((log.episodes(), log.standing()) for log in logs), strict=True)
        together = on_host((states, envs))
        parts = [
            (*jax.tree.map(lambda leaf, k=number: leaf[k], together), latest)
            for number, latest in enumerate(episodes)
        ]
        self._saver.report(self._env_steps, standings, parts)

    def _save_all(self, env_steps: int, standings: Sequence[Standing], parts: Any) -> None:
        going_on = [number for number, one in enumerate(self._members) if one.error is None]
        for number in going_on:  # In turn: orbax can block when several threads use it.
            self._members[number].save(env_steps, *parts[number])
        # All at once, so that after a fault they go on from the same step.
        for number in going_on:
            if self._members[number].error is None:
                self._members[number].name_checkpoint(env_steps, standings[number])


def _iterate_all(
    env: BatchedEnv,
    learner: Learner[PpoConfig],
    peers: Peers,
    model: PyTree,
    states: TrainState,
    envs: BatchState,
) -> tuple[TrainState, BatchState, IterationMetrics]:
    """An iteration of all runs; states and metrics have a leading axis [K]."""
    one = partial(iterate, env, learner, peers, model)
    return jax.vmap(one)(states, envs)


@jax.jit
def _stack(trees: list[Any]) -> Any:
    """One tree whose leaves have a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
