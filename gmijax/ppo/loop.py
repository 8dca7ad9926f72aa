"""The training loop of a GMI in synchronous training: checkpoints, metrics, agreement to stop.

Every GMI that trains runs this same routine; the reducer keeps them in step and makes their
learner states equal. The leader (rank 0) alone writes metrics and the shared part of checkpoints.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.collectives.interface import Reducer, TracedStep
from gmijax.config import PpoConfig, TrainConfig
from gmijax.devices import describe_device
from gmijax.errors import CollectiveError
from gmijax.learning.checkpoint import (
    checkpoint_meta,
    require_equal,
    require_finite,
    save_episodes,
)
from gmijax.learning.checkpoint_saver import CheckpointSaver
from gmijax.learning.evaluator import Evaluation, Evaluator, evaluation_worlds
from gmijax.learning.iteration_trace import IterationTrace
from gmijax.learning.learner import TrainState, make_learner
from gmijax.learning.policy_file import save_policy
from gmijax.learning.report_thread import ReportThread
from gmijax.learning.start import first_envs, first_state, first_window
from gmijax.learning.throughput import ThroughputMeter
from gmijax.learning.training_log import Learnt, TrainingLog
from gmijax.ppo.ppo import IterationMetrics, iterate
from gmijax.ppo.tdg_ex import RemoteIteration, RolloutWorkers
from gmijax.runs.folder import write_json
from gmijax.runs.resume import best_evaluation
from gmijax.sim.wrappers import BatchedEnv
from gmijax.supervise.child import ChildLink


class TrainingLoop:
    """One GMI's training run.

    Args:
      config: of the run.
      env: the environments; where others make the rollouts, like theirs.
      reducer: among the GMIs that train.
      link: to the controller.
      workers: the GMIs that make this one's rollouts, None where it does so itself.
    """

    def __init__(
        self,
        config: TrainConfig,
        env: BatchedEnv,
        reducer: Reducer,
        link: ChildLink,
        workers: RolloutWorkers | None = None,
    ) -> None:
        assert isinstance(config.algo, PpoConfig)
        self._config = config
        self._env = env
        self._reducer = reducer
        self._link = link
        self._leader = reducer.rank == 0
        self._warms_up = config.algo.warmup_unroll and config.run.resume is None
        self._learner = make_learner(env.spec, config.algo)
        self._remote: RemoteIteration | None = None
        num_simulating = reducer.world_size
        if workers is None:
            self._iteration = reducer.program(partial(iterate, env, self._learner))
        else:
            self._iteration = self._remote = RemoteIteration(env, self._learner, reducer, workers)
            num_simulating *= len(workers.gmis)
        self._steps_per_iteration = (
            config.envs_per_gmi * config.algo.unroll_length * num_simulating
        )
        self._meter: ThroughputMeter | None = None
        # Who has no environments cannot measure how fast they are.
        if config.run.measure_throughput and self._remote is None:
            self._meter = ThroughputMeter(env, self._learner, config, reducer)
        self._evaluator: Evaluator | None = None
        if config.eval.every is not None:
            worlds = evaluation_worlds(config, reducer.rank, reducer.world_size)
            self._evaluator = Evaluator(worlds, self._learner, config, reducer, link.run)
        self._env_steps = 0
        self._iterations = 0
        self._checkpoint: Path | None = None
        keep = config.run.keep_checkpoints
        self._saver = CheckpointSaver(link.run, link.gmi, reducer, keep)
        traced = config.run.profiled if self._leader else None
        self._trace = IterationTrace(traced, link.run.profile)

    def run(self) -> dict[str, Any]:
        """Trains until `num_timesteps` or until the controller asks for an end.

        Returns:
          The outcome for `result.json`.

        Raises:
          NonFiniteError: simulation or learning produced NaN or infinity.
          ParameterMismatch: the GMIs' parameters differ.
          CollectiveError: another GMI is gone or stuck.
        """
        started = time.monotonic()
        self._link.end_part("environments")
        state, self._env_steps = first_state(self._learner, self._env.spec.obs_size, self._config)
        if self._evaluator is not None:
            self._evaluator.best = best_evaluation(self._link.run.root, self._env_steps)
        env_state = self._first_envs()
        self._link.end_part("states")
        waited_s = self._compile(state, env_state)
        compile_s = time.monotonic() - started - waited_s
        self._link.beat("ready", 0)
        self._meet()  # Everybody has compiled: the clock may start.
        if self._warms_up:
            state, env_state = warm_up(self._iteration, state, env_state)
        log = self._open_log()
        first_steps, started = self._env_steps, time.monotonic()
        state, env_state, stopped = self._train(state, env_state, log)
        eval_s = 0.0 if self._evaluator is None else self._evaluator.wall_s
        wall_s = time.monotonic() - started - eval_s
        done = {
            "status": "stopped" if stopped else "completed",
            "env_steps": self._env_steps,
            "iterations": self._iterations,
            "train_wall_s": wall_s,
            "compile_s": compile_s,
            "start_s": self._link.start_s | {"first_update": next(iter(log.line_s), None)},
            "env_steps_per_s": (self._env_steps - first_steps) / wall_s,
            "step_per_s_train": self._median_rate(log.line_s),
            "final_return": log.last_return,
            "overflow_steps": log.overflows.steps,
            "checkpoint": str(self._checkpoint) if self._checkpoint else None,
            "device": describe_device(),
            **self._trace.outcome(),
        }
        if self._meter is not None and not stopped:
            # Written before: whatever happens to the measurement, the training is done.
            write_json(self._link.paths.result, done)
            done |= self._meter.measure(
                state, env_state, lambda: self._link.beat("running", self._iterations)
            )
        return done

    def _first_envs(self) -> Any:
        if self._remote is not None:
            return None
        return first_envs(
            self._env,
            self._config,
            self._reducer.rank,
            gmi=self._link.gmi,
            num_gmis=self._reducer.world_size,
        )

    def _compile(self, state: TrainState, env_state: Any) -> float:
        """Makes all programs; returns the seconds for which others compiled."""
        # Every GMI does that itself, at the same time.
        self._iteration.trace(self._env.model, state, env_state)
        if self._meter is not None:
            self._meter.trace(state, env_state)
        if self._evaluator is not None:
            self._evaluator.trace(state)
        self._link.begin_compiling()
        self._iteration.compile()
        if self._meter is not None:
            self._meter.compile()
        if self._evaluator is not None:
            self._evaluator.compile()
        self._link.end_part("compiling")
        return self._link.start_s["waiting"]

    def _open_log(self) -> TrainingLog:
        name = self._config.env.label
        if not self._leader:
            return TrainingLog(name, (), self._env_steps)
        steps_at_once = self._steps_per_iteration // self._config.algo.unroll_length
        window = first_window(
            self._config,
            self._env.spec.episode_length * steps_at_once,
            self._link.gmi,
            self._reducer.world_size,
        )
        return TrainingLog.open(name, self._link.run, self._env_steps, window)

    def _train(
        self, state: TrainState, env_state: Any, log: TrainingLog
    ) -> tuple[TrainState, Any, bool]:
        """Trains to the end; returns also whether it was asked to stop."""
        thread = ReportThread(lambda *line: report(log, *line))
        try:
            trained = self._loop(state, env_state, thread, log)
        except CollectiveError:
            thread.give_up()  # It may wait for a device that waits for a GMI that is gone.
            raise
        finally:
            thread.stop()
            self._saver.stop()
            log.close()
        if self._remote is not None:
            self._remote.close()
        return trained

    def _loop(
        self, state: TrainState, env_state: Any, thread: ReportThread, log: TrainingLog
    ) -> tuple[TrainState, Any, bool]:
        every = self._config.run.checkpoint_every
        stop, evaluation = False, None
        while self._env_steps < self._config.num_timesteps and not stop:
            self._iterations += 1
            self._trace.begin(self._iterations, self._iteration.wait)
            state, env_state, metrics = self._iteration(state, env_state)
            self._trace.end(self._iterations, self._iteration.wait)
            self._env_steps += self._steps_per_iteration
            evaluation = self._evaluate(state)
            thread.report(self._env_steps, metrics, self._times(), evaluation)
            # Counted from the run's start, so that it says the same after a restart.
            self._link.beat("running", self._env_steps // self._steps_per_iteration)
            stop = self._agree_to_stop()
            is_last = stop or self._env_steps >= self._config.num_timesteps
            is_due = every and self._iterations % every == 0
            if not is_last and (is_due or (evaluation is not None and evaluation.is_best)):
                self._save(state, env_state, thread, log, evaluation)
        self._save(state, env_state, thread, log, evaluation)
        self._checkpoint = self._saver.finish()
        self._trace.close()  # Last: a job that is told to end has little time to save.
        return state, env_state, stop

    def _evaluate(self, state: TrainState) -> Evaluation | None:
        """Evaluates if it is time to, in the same iteration on all GMIs."""
        env_steps, before = self._env_steps, self._env_steps - self._steps_per_iteration
        is_end = env_steps >= self._config.num_timesteps
        if self._evaluator is None or not (is_end or self._evaluator.is_due(env_steps, before)):
            return None
        self._iteration.wait()  # The time of its line.
        iteration = env_steps // self._steps_per_iteration
        return self._evaluator.run(
            state,
            env_steps,
            lambda: self._link.beat("running", iteration),
            lambda: self._link.stop_requested,
        )

    def _times(self) -> dict[str, float]:
        """Seconds of parts of an iteration, where they are known."""
        reduce_s = self._iteration.exchange_s
        times = {} if reduce_s is None else {"time/reduce_s": reduce_s}
        if self._remote is not None:
            times["time/rollout_s"] = self._remote.rollout_s
        return times

    def _agree_to_stop(self) -> bool:
        # Only one GMI may have heard of it yet; all must leave after the same iteration.
        mine = np.array([self._link.stop_requested, self._saver.is_written], np.float32)
        stops, are_written = self._reducer.all_gather(mine).T
        if are_written.all():
            self._saver.name()
        return bool(stops.any())

    def _save(
        self,
        state: TrainState,
        env_state: Any,
        thread: ReportThread,
        log: TrainingLog,
        evaluation: Evaluation | None,
    ) -> None:
        """Begins to write a checkpoint."""
        self._iteration.wait()
        thread.wait()  # A resumed run goes on from the lines up to its checkpoint.
        config, steps = self._config, self._env_steps
        require_equal(self._reducer, self._link.gmi, state.params, steps)
        require_finite(state.params, config.env.label, steps)
        num_gmis, episodes = self._reducer.world_size, log.episodes()
        evaluated = None if evaluation is None else evaluation.mean_return
        meta = checkpoint_meta(config, steps, num_gmis, log.standing(), evaluated)

        def save_more(host_state: TrainState) -> None:
            save_policy(self._link.run, steps, config.env, config.algo, host_state)
            save_episodes(self._link.run, steps, config, episodes)

        self._saver.begin(meta, state, env_state, save_more)

    def _meet(self) -> None:
        """Returns when all GMIs have called it."""
        self._reducer.all_gather(np.zeros(1, np.float32))

    def _median_rate(self, iteration_s: list[float]) -> float | None:
        # The first iteration fills caches and pools, and its metrics come late.
        steady = iteration_s[1:] or iteration_s
        return self._steps_per_iteration / statistics.median(steady) if steady else None


def warm_up(iteration: TracedStep, state: TrainState, env_state: Any) -> tuple[TrainState, Any]:
    """Makes an iteration of which only the statistics of observations and targets are kept.

    Both arguments are donated.

    Returns:
      `state` with these statistics, and the environments where the iteration has left them.
    """
    first = jax.tree.map(jnp.copy, state)
    after, env_state, _ = iteration(state, env_state)
    iteration.wait()
    warm = first._replace(obs_moments=after.obs_moments, value_moments=after.value_moments)
    return warm, env_state


def report(
    log: TrainingLog,
    env_steps: int,
    metrics: IterationMetrics,
    times: Mapping[str, float],
    evaluation: Evaluation | None = None,
) -> None:
    """Waits for the iteration that ended at `env_steps` and writes its line.

    `times` are seconds by name, written as they are. Raises as `TrainingLog.write`.
    """
    host: Any = jax.tree.map(float, jax.device_get(metrics))
    learnt = Learnt(host.losses._asdict(), host.figures, host.rates)
    if evaluation is None:
        log.write(env_steps, host.counts, learnt, times)
        return
    log.write(
        env_steps,
        host.counts,
        learnt,
        {**times, **evaluation.metrics},
        now_s=evaluation.started_s,
        paused_s=evaluation.wall_s,
    )
