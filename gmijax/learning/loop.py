"""The training loop of a GMI, whatever the algorithm: start, metrics, evaluations, checkpoints.

Every GMI that trains runs this same routine; the communicator keeps them in step and makes their
learner states equal. The leader (rank 0) alone writes metrics and the shared part of checkpoints.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.collectives.interface import Communicator, TracedStep
from gmijax.devices import describe_device
from gmijax.errors import CollectiveError
from gmijax.learning.algorithm import Algorithm
from gmijax.learning.checkpoint import require_disk_for, require_equal
from gmijax.learning.checkpoint_saver import CheckpointSaver
from gmijax.learning.evaluator import Evaluation, Evaluator, evaluation_envs
from gmijax.learning.iteration_trace import IterationTrace
from gmijax.learning.learner import Learner, TrainState
from gmijax.learning.member import Member, Members
from gmijax.learning.report_thread import ReportThread
from gmijax.learning.start import first_envs, first_state
from gmijax.learning.throughput import ThroughputMeter
from gmijax.runs.folder import RunPaths, write_json
from gmijax.runs.ranking import best_evaluation
from gmijax.runs.result import TrainResult
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.supervise.child import ChildLink
from gmijax.types import PyTree


class TrainingLoop:
    """One GMI's part of a training run; or several runs, in a job of one GMI.

    Args:
      members: the runs.
      algorithm: what they train with.
      learner: its networks, optimiser and hyper-parameters.
      env: the environments of all members; where others make the rollouts, like theirs.
      iteration: the program of an iteration, of all members.
      comm: among the GMIs that train.
      link: to the controller.
      remote: how many other GMIs simulate for this one, which then has no environments.
      times: seconds of other parts of the last iteration, by the names that they are logged under.
      exchange: `strategy`, `intra` and `inter` that are used, where they may differ from the
        plan's.
    """

    def __init__(
        self,
        members: Members,
        algorithm: Algorithm,
        learner: Learner,
        env: BatchedEnv,
        iteration: TracedStep,
        comm: Communicator,
        link: ChildLink,
        *,
        remote: int = 0,
        times: Callable[[], Mapping[str, float]] = dict,
        exchange: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._members, self._algorithm, self._learner = members, algorithm, learner
        self._env, self._iteration, self._comm, self._link = env, iteration, comm, link
        self._config = config = members.first.config
        self._remote, self._other_times, self._exchange = remote, times, exchange
        self._is_leader = comm.rank == 0
        self._steps_per_iteration = (
            config.envs_per_gmi * config.algo.unroll_length * comm.world_size * (remote or 1)
        )
        self._meter: ThroughputMeter | None = None
        # A GMI without environments cannot measure how fast they are.
        if config.run.measure_throughput and members.is_one and not remote:
            self._meter = ThroughputMeter(env, learner, config, comm)
        self._evaluator: Evaluator | None = None
        if config.eval.every is not None:
            envs = evaluation_envs(config, comm.rank, comm.world_size)
            self._evaluator = Evaluator(envs, learner, config, comm, members.first.run)
        self._env_steps = self._iterations = 0
        self._saver = CheckpointSaver(link.gmi, comm, config.run.keep_checkpoints)
        self._trace = IterationTrace(
            config.run.profiled if members.is_one else None,
            members.first.run.profile,
            is_written=self._is_leader,
        )

    def run(self) -> None:
        """Trains until `num_timesteps` or until the controller asks for an end.

        Writes `result.json` of every run. Of several, those whose numbers are no longer finite
        end alone, with an `error.json`.

        Raises:
          NonFiniteError: simulation or learning of the only run produced NaN or infinity.
          ParameterMismatch: the GMIs' parameters differ.
          CollectiveError: another GMI is gone or stuck.
        """
        started_s = time.monotonic()
        self._link.end_part("environments")
        state, memory = self._first()
        self._link.end_part("states")
        waited_s = self._compile(state, memory)
        compile_s = time.monotonic() - started_s - waited_s
        self._link.beat("ready", 0)
        self._comm.all_gather(np.zeros(1, np.float32))  # All have compiled: the clock starts.
        config = self._config
        if config.algo.warms_up and config.run.resume is None:
            state, memory = warm_up(self._iteration, state, memory)
        self._open_logs()
        first_steps, started_s = self._env_steps, time.monotonic()
        state, memory, is_stopped = self._train(state, memory)
        eval_s = 0.0 if self._evaluator is None else self._evaluator.wall_s
        train_s = time.monotonic() - started_s - eval_s, compile_s
        results = [
            (member.run, self._result(member, first_steps, train_s, is_stopped=is_stopped))
            for member in self._members.going_on
        ]
        for run, result in results:
            self._write(run, result)
        if self._meter is not None and not is_stopped:
            # Written before: whatever happens to the measurement, the training is done.
            envs = self._algorithm.envs(memory)
            rates = self._meter.measure(
                state, envs, lambda: self._link.beat("running", self._iterations)
            )
            [(run, result)] = results
            self._write(run, dataclasses.replace(result, **rates))

    def _first(self) -> tuple[TrainState, Any]:
        """State of the learner and this GMI's memory, with an axis of members if several."""
        state = self._members.stacked(self._first_state)
        memory = None if self._remote else self._first_memory()
        if self._evaluator is not None:
            self._evaluator.best = best_evaluation(self._members.first.run.root, self._env_steps)
        return state, memory

    def _first_state(self, member: Member) -> TrainState:
        state, self._env_steps = first_state(
            self._algorithm.init, self._learner, self._env.spec.obs_size, member.config
        )
        return state

    def _first_memory(self) -> Any:
        members, gmi, ranks = self._members, self._link.gmi, self._comm
        envs = members.stacked(
            lambda member: first_envs(
                *(self._env, member.config, ranks.rank),
                gmi=gmi,
                num_gmis=ranks.world_size,
                num_runs=members.count,
            )
        )

        def begin(envs: BatchState, replay: PyTree | None) -> Any:
            memory = self._algorithm.begin(self._learner, self._env, envs)
            return memory if replay is None else self._algorithm.with_replay(memory, replay)

        made = jax.eval_shape(members.each(begin), envs, None)
        template = self._algorithm.replay(self._learner, made)
        require_disk_for(members.first.run, template, ranks.world_size)
        replay = members.restored_replay(template, gmi, ranks.world_size)
        # In a program, which makes a replay where it stays: there may be no memory for another.
        make = jax.jit(members.each(begin), donate_argnums=(0, 1))
        return make(envs, jax.device_put(replay))

    def _compile(self, state: TrainState, memory: Any) -> float:
        """Makes all programs; returns the seconds for which others compiled."""
        # Every GMI does that itself, at the same time.
        self._iteration.trace(self._env.model, state, memory)
        if self._meter is not None:
            self._meter.trace(state, self._algorithm.envs(memory))
        if self._evaluator is not None:
            self._evaluator.trace(state)
        self._link.begin_compiling()
        for program in (self._iteration, self._meter, self._evaluator):
            if program is not None:
                program.compile()
        self._link.end_part("compiling")
        return self._link.start_s["waiting"]

    def _open_logs(self) -> None:
        steps_at_once = self._steps_per_iteration // self._config.algo.unroll_length
        for member in self._members.going_on:
            member.open_log(
                self._env_steps,
                self._env.spec.episode_length * steps_at_once,
                self._link.gmi,
                self._comm.world_size,
                is_leader=self._is_leader,
            )

    def _train(self, state: TrainState, memory: Any) -> tuple[TrainState, Any, bool]:
        """Trains to the end; returns also whether it was asked to stop."""
        thread = ReportThread(self._members.report)
        try:
            return self._loop(state, memory, thread)
        except CollectiveError:
            thread.give_up()  # It may wait for a device that waits for a GMI that is gone.
            raise
        finally:
            thread.stop()
            self._saver.stop()
            self._members.close()

    def _loop(
        self, state: TrainState, memory: Any, thread: ReportThread
    ) -> tuple[TrainState, Any, bool]:
        num_timesteps, every = self._config.num_timesteps, self._config.run.checkpoint_every
        stop, evaluation = False, None
        while self._env_steps < num_timesteps and not stop and self._members.going_on:
            self._iterations += 1
            self._trace.begin(self._iterations, self._iteration.wait)
            state, memory, metrics = self._iteration(state, memory)
            self._trace.end(self._iterations, self._iteration.wait)
            self._env_steps += self._steps_per_iteration
            evaluation = self._evaluate(state)
            thread.report(self._env_steps, metrics, self._times(), evaluation)
            # Counted from the run's start, so that it is the same after a restart.
            self._link.beat("running", self._env_steps // self._steps_per_iteration)
            stop = self._agree_to_stop()
            is_last = stop or self._env_steps >= num_timesteps
            is_due = every and self._iterations % every == 0
            if not is_last and (is_due or (evaluation is not None and evaluation.is_best)):
                self._save(state, memory, None, thread, evaluation)
        self._save(state, memory, None, thread, evaluation)
        replay = None if self._remote else self._algorithm.replay(self._learner, memory)
        if replay is not None:
            # It can be many GiB: written once, and last, since time or disk may not suffice for
            # it. This checkpoint then replaces the one without it.
            self._save(state, memory, replay, thread, evaluation)
        self._saver.finish()
        self._trace.close()  # Last: a job that is to end has little time to save.
        return state, memory, stop

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
        return {**times, **self._other_times()}

    def _agree_to_stop(self) -> bool:
        # A request may have reached only one GMI yet; all must stop after the same iteration.
        local = np.array([self._link.stop_requested, self._saver.is_written], np.float32)
        stops, are_written = self._comm.all_gather(local).T
        if are_written.all():
            self._saver.name()
        return bool(stops.any())

    def _save(
        self,
        state: TrainState,
        memory: Any,
        replay: PyTree | None,
        thread: ReportThread,
        evaluation: Evaluation | None,
    ) -> None:
        """Begins to write a checkpoint of every run; training continues meanwhile."""
        self._iteration.wait()
        thread.wait()  # A resumed run continues after the lines up to its checkpoint.
        self._saver.finish()  # Two copies on the host at once may be too much.
        learned = self._algorithm.learned(state)
        require_equal(self._comm, self._link.gmi, learned, self._env_steps)
        parts = self._members.parts(
            self._env_steps,
            self._comm.world_size,
            state,
            learned,
            None if self._remote else self._algorithm.envs(memory),
            replay,
            evaluation,
            is_leader=self._is_leader,
        )
        if parts:
            self._saver.begin(parts)

    def _result(
        self,
        member: Member,
        first_steps: int,
        train_s: tuple[float, float],
        *,
        is_stopped: bool,
    ) -> TrainResult:
        """The outcome of a run; `train_s` are the seconds of training and of compiling."""
        (wall_s, compile_s), log, saved = train_s, member.log, self._saver.last_steps
        return TrainResult(
            status="stopped" if is_stopped else "completed",
            env_steps=self._env_steps,
            iterations=self._iterations,
            train_wall_s=wall_s,
            compile_s=compile_s,
            start_s=self._link.start_s | {"first_update": next(iter(log.line_s), None)},
            env_steps_per_s=(self._env_steps - first_steps) / wall_s,
            step_per_s_train=member.median_rate(self._steps_per_iteration),
            final_return=log.last_return,
            overflow_steps=log.overflows.steps,
            checkpoint=None if saved is None else str(member.run.checkpoint(saved)),
            device=describe_device(),
            profile=self._trace.outcome(),
            strategy=self._exchange.get("strategy"),
            intra=self._exchange.get("intra"),
            inter=self._exchange.get("inter"),
        )

    def _write(self, run: RunPaths, result: TrainResult) -> None:
        write_json(run.gmi(self._link.gmi).result, result.to_dict())


def warm_up(iteration: TracedStep, state: TrainState, memory: Any) -> tuple[TrainState, Any]:
    """Makes an iteration of which only the statistics of observations and targets are kept.

    Both arguments are donated.

    Returns:
      `state` with these statistics, and the memory as the iteration has left it.
    """
    first = jax.tree.map(jnp.copy, state)
    after, memory, _ = iteration(state, memory)
    iteration.wait()
    warm = first._replace(obs_moments=after.obs_moments, value_moments=after.value_moments)
    return warm, memory
