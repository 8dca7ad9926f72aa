"""The role of a GMI in synchronous training: simulator, agent and trainer in one (TCG_EX).

Every GMI runs this same routine; the reducer keeps them in step and makes their learner states
equal. The leader (rank 0) alone writes metrics and the shared part of checkpoints.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.checkpoint import digest, has_envs, restore_envs, restore_learner, save_checkpoint
from gmijax.collectives.interface import Reducer
from gmijax.config import TrainConfig
from gmijax.devices import describe_device
from gmijax.errors import CollectiveError, NonFiniteError, ParameterMismatch
from gmijax.learner import Learner, LearnerState, init_learner, make_learner
from gmijax.metrics import JsonlSink, MetricsLog, TensorBoardSink
from gmijax.partition.child import ChildLink
from gmijax.ppo.programs import FusedIteration, Iteration, SpmdIteration
from gmijax.ppo.remote import RemoteIteration, Servants
from gmijax.ppo.report import Reporter, ReportThread
from gmijax.ppo.split import SplitIteration
from gmijax.ppo.throughput import ThroughputMeter
from gmijax.results import read_metrics
from gmijax.resume import CheckpointMeta
from gmijax.rundir import RunPaths, read_json, write_json
from gmijax.sim.wrappers import BatchedEnv, env_keys


def train(
    config: TrainConfig,
    env: BatchedEnv,
    reducer: Reducer,
    link: ChildLink,
    servants: Servants | None = None,
) -> dict[str, Any]:
    """Trains until `num_timesteps` or until the controller asks for an end.

    Args:
      config: of the run.
      env: the environments; where others make the rollouts, one of theirs.
      reducer: among the GMIs that train.
      link: to the controller.
      servants: the GMIs that make this one's rollouts, None where it does so itself.

    Returns:
      The outcome for `result.json`.

    Raises:
      NonFiniteError: simulation or learning produced NaN or infinity.
      ParameterMismatch: the GMIs' parameters differ.
      CollectiveError: another GMI is gone or stuck.
    """
    return _SyncTrainer(config, env, reducer, link, servants).run()


class _SyncTrainer:
    """One GMI's training run; see `train`."""

    def __init__(
        self,
        config: TrainConfig,
        env: BatchedEnv,
        reducer: Reducer,
        link: ChildLink,
        servants: Servants | None,
    ) -> None:
        self._config = config
        self._env = env
        self._reducer = reducer
        self._link = link
        self._leader = reducer.rank == 0
        self._servants = servants
        self._steps_per_iteration = (
            config.envs_per_gmi
            * config.algo.unroll_length
            * reducer.world_size
            * (1 if servants is None else len(servants.gmis))
        )
        # Who has no environments cannot measure how fast they are.
        self._measures = config.run.measure_throughput and servants is None
        self._learner: Learner = make_learner(env.spec, config.algo)
        self._iteration = self._make_iteration()
        self._env_steps = 0
        self._iterations = 0
        self._checkpoint: Path | None = None

    def run(self) -> dict[str, Any]:
        """See `train`."""
        started = time.monotonic()
        state, env_state = self._first_state()
        meter = ThroughputMeter(self._env, self._learner, self._config, self._reducer)
        waited_s = self._compile(state, env_state, meter)
        compile_s = time.monotonic() - started - waited_s
        self._link.beat("ready", 0)
        self._meet()  # Everybody has compiled: the clock may start.
        reporter = self._make_reporter()
        first_steps, started = self._env_steps, time.monotonic()
        state, env_state, stopped = self._train(state, env_state, reporter)
        wall_s = time.monotonic() - started
        done = {
            "status": "stopped" if stopped else "completed",
            "env_steps": self._env_steps,
            "iterations": self._iterations,
            "train_wall_s": wall_s,
            "compile_s": compile_s,
            "env_steps_per_s": (self._env_steps - first_steps) / wall_s,
            "step_per_s_train": self._median_rate(reporter.iteration_s),
            "final_return": reporter.last_return,
            "overflow_steps": reporter.overflows.steps,
            "checkpoint": str(self._checkpoint) if self._checkpoint else None,
            "device": describe_device(),
        }
        if self._measures and not stopped:
            # Written before: whatever happens to the measurement, the training is done.
            write_json(self._link.paths.result, done)
            rates = meter.measure(
                state, env_state, lambda: self._link.beat("running", self._iterations)
            )
            done |= rates._asdict()
        return done

    def _compile(self, state: LearnerState, env_state: Any, meter: ThroughputMeter) -> float:
        """Makes all programs; returns the seconds for which it was not this GMI's turn."""
        self._iteration.trace(state, env_state)
        if self._measures:
            meter.trace(state, env_state)
        waited_s = self._link.begin_compiling()
        self._iteration.compile()
        if self._measures:
            meter.compile()
        return waited_s

    def _make_reporter(self) -> Reporter:
        history = read_metrics(self._link.run.metrics) if self._leader else []
        wall_s = history[-1]["wall_s"] if history else 0.0
        log = self._open_log(history)
        return Reporter(self._config.env.label, log, self._env_steps, wall_s)

    def _train(
        self, state: LearnerState, env_state: Any, reporter: Reporter
    ) -> tuple[LearnerState, Any, bool]:
        """Trains to the end; returns also whether it was asked to stop."""
        lines = ReportThread(reporter)
        try:
            trained = self._loop(state, env_state, lines)
        except CollectiveError:
            lines.give_up()  # It may wait for a device that waits for a GMI that is gone.
            raise
        finally:
            lines.stop()
            reporter.close()
        if isinstance(self._iteration, RemoteIteration):
            self._iteration.close()
        return trained

    def _make_iteration(self) -> Iteration:
        env, learner, reducer = self._env, self._learner, self._reducer
        if self._servants is not None:
            return RemoteIteration(env, learner, reducer, self._servants)
        if reducer.world_size == 1:
            return FusedIteration(env, learner)
        spmd = SpmdIteration.if_possible(env, learner, reducer)
        return spmd or SplitIteration(env, learner, reducer)

    def _first_state(self) -> tuple[LearnerState, Any]:
        base = jax.random.key(self._config.seed)
        learner_key, env_key = jax.random.split(base)
        spec = self._env.spec
        state = jax.jit(lambda key: init_learner(self._learner, spec.obs_size, key))(learner_key)
        resume = self._config.run.resume
        if resume is None:
            return state, self._reset_envs(env_key)
        meta = CheckpointMeta.read(Path(resume))
        self._env_steps = meta.env_steps
        state = self._with_wanted_rate(restore_learner(Path(resume), state), Path(resume))
        # Other environments than the first run's: these never saw the first run's start.
        env_state = self._reset_envs(jax.random.fold_in(env_key, meta.env_steps % 2**31))
        if self._servants is not None or not has_envs(Path(resume), self._link.gmi):
            return state, env_state
        same = (self._reducer.world_size, self._config.envs_per_gmi, self._config.physics.impl)
        if (meta.num_gmis, meta.num_envs, meta.impl) == same:
            env_state = restore_envs(Path(resume), self._link.gmi, env_state)
        return state, env_state

    def _with_wanted_rate(self, state: LearnerState, checkpoint: Path) -> LearnerState:
        # The schedule's rate is part of the state, unless the user asks for another one now.
        wanted = self._config.algo.learning_rate
        saved = read_json(RunPaths(checkpoint.parent.parent).config)["algo"]["learning_rate"]
        if wanted == saved:
            return state
        return state._replace(learning_rate=jnp.asarray(wanted, jnp.float32))

    def _reset_envs(self, key: jax.Array) -> Any:
        # The key of an environment comes from its number in the whole job, so that k GMIs of n
        # environments and one of k * n simulate the same ones.
        if self._servants is not None:
            return None
        num_envs = self._config.envs_per_gmi
        keys = env_keys(key, self._reducer.rank * num_envs, num_envs)
        return jax.jit(self._env.init)(self._env.model, keys)

    def _loop(
        self, state: LearnerState, env_state: Any, lines: ReportThread
    ) -> tuple[LearnerState, Any, bool]:
        every = self._config.run.checkpoint_every
        stop = False
        while self._env_steps < self._config.num_timesteps and not stop:
            state, env_state, metrics = self._iteration(state, env_state)
            self._env_steps += self._steps_per_iteration
            self._iterations += 1
            lines.report(self._env_steps, metrics, self._iteration.times)
            # Counted from the run's start, so that it says the same after a restart.
            self._link.beat("running", self._env_steps // self._steps_per_iteration)
            stop = self._agree_to_stop()
            is_last = stop or self._env_steps >= self._config.num_timesteps
            if not is_last and every and self._iterations % every == 0:
                self._settle(lines)  # A resumed run goes on from the lines up to its checkpoint.
                self._save(state, env_state, lines.last_return)
        self._settle(lines)
        self._save(state, env_state, lines.last_return)
        return state, env_state, stop

    def _settle(self, lines: ReportThread) -> None:
        self._iteration.wait()
        lines.wait()

    def _agree_to_stop(self) -> bool:
        # Only one GMI may have heard of it yet; all must leave after the same iteration.
        mine = np.array([self._link.stop_requested], np.float32)
        return bool(self._reducer.all_gather(mine).any())

    def _save(self, state: LearnerState, env_state: Any, mean_return: float | None) -> None:
        digests = self._reducer.all_gather(digest(state.params))
        if different := [r for r in range(len(digests)) if (digests[r] != digests[0]).any()]:
            raise ParameterMismatch(
                f"after {self._env_steps} env steps the parameters of GMIs {different} differ "
                "from those of GMI 0"
            )
        if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(state.params)):
            raise NonFiniteError(
                f"{self._config.env.label}: parameters are not finite after "
                f"{self._env_steps} env steps; nothing was saved"
            )
        self._checkpoint = save_checkpoint(
            self._link.run,
            self._meta(mean_return),
            state,
            env_state,
            gmi=self._link.gmi,
            leader=self._leader,
            barrier=self._meet,
            keep=self._config.run.keep_checkpoints,
        )

    def _meet(self) -> None:
        """Returns when all GMIs have called it."""
        self._reducer.all_gather(np.zeros(1, np.float32))

    def _meta(self, mean_return: float | None) -> CheckpointMeta:
        algo = self._config.algo
        return CheckpointMeta(
            env=self._config.env.label,
            algo=algo.name,
            env_steps=self._env_steps,
            num_gmis=self._reducer.world_size,
            num_envs=self._config.envs_per_gmi,
            hidden=(algo.policy_hidden_layer_sizes, algo.value_hidden_layer_sizes),
            impl=self._config.physics.impl,
            mean_return=mean_return,
        )

    def _median_rate(self, iteration_s: list[float]) -> float | None:
        # The first iteration fills caches and pools, and its metrics come late.
        steady = iteration_s[1:] or iteration_s
        return self._steps_per_iteration / statistics.median(steady) if steady else None

    def _open_log(self, history: list[dict[str, Any]]) -> MetricsLog:
        if not self._leader:
            return MetricsLog(())
        run = self._link.run
        board = TensorBoardSink(run.tensorboard)
        for line in history:  # A resumed run starts with the lines of the one before.
            board.write(line)
        return MetricsLog((JsonlSink(run.metrics), board))
