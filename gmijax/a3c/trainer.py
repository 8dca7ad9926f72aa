"""The role of a training GMI: takes experience, learns, publishes weights.

All trainers make the same updates; the first leads them: it publishes the weights, tells the
agents what to do, writes metrics and the shared part of checkpoints.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmijax.a3c.board import JobRegisters
from gmijax.a3c.leader import Leader
from gmijax.a3c.learner import acting_weights, pack_weights
from gmijax.a3c.losses import LossMetrics, Unrolls
from gmijax.a3c.programs import FusedUpdate, SplitUpdate, Update
from gmijax.a3c.report import Told
from gmijax.a3c.staleness import MAX_COUNTED, histogram_of
from gmijax.a3c.tally import Tally
from gmijax.checkpoint import digest, restore_learner
from gmijax.collectives.channel.batcher import Batch, Batcher
from gmijax.collectives.interface import Reducer
from gmijax.config import A3cConfig, TrainConfig
from gmijax.errors import CollectiveTimeout, NonFiniteError, ParameterMismatch
from gmijax.learner import LearnerState, init_learner, make_learner
from gmijax.partition.child import ChildLink
from gmijax.resume import CheckpointMeta
from gmijax.sim.wrappers import BatchedEnv

_SLICE_S = 0.5
"""Longest wait for experience before the trainer says that it is alive."""


class Training(NamedTuple):
    """What a trainer is made of.

    Attributes:
      config: of the run.
      algo: of the run, too.
      env: one of the environments, for its sizes; it is not stepped.
      agents: ids of the GMIs that act.
    """

    config: TrainConfig
    algo: A3cConfig
    env: BatchedEnv
    agents: tuple[int, ...]


def learn_until_done(
    training: Training,
    registers: JobRegisters,
    receiver: Batcher,
    reducer: Reducer,
    link: ChildLink,
) -> dict[str, Any]:
    """Learns until `num_timesteps` are consumed or the controller asks for an end.

    Returns:
      The outcome for `result.json`; of the leader, that of the job.

    Raises:
      NonFiniteError: simulation or learning produced NaN or infinity.
      ParameterMismatch: the trainers' parameters differ.
      CollectiveError: another GMI is gone or stuck.
    """
    return _Trainer(training, registers, receiver, reducer, link).run()


class _Trainer:
    """One training GMI; see `learn_until_done`."""

    def __init__(
        self,
        training: Training,
        registers: JobRegisters,
        receiver: Batcher,
        reducer: Reducer,
        link: ChildLink,
    ) -> None:
        self._config = training.config
        self._algo = training.algo
        self._env = training.env
        self._agents = training.agents
        self._receiver = receiver
        self._reducer = reducer
        self._link = link
        self._batch_size = training.algo.batch_of(training.config.envs_per_gmi)
        self._learner = make_learner(self._env.spec, training.algo)
        self._update: Update = (
            FusedUpdate(self._learner)
            if reducer.world_size == 1
            else SplitUpdate(self._learner, self._env.spec.obs_size, reducer)
        )
        self._env_steps = 0
        self._updates = 0
        self._version = 0
        self._passed_over = np.zeros(MAX_COUNTED + 1, np.float32)
        self._lead = None
        if reducer.rank == 0:
            self._lead = Leader(training.config, self._env, registers, link, training.agents)

    def run(self) -> dict[str, Any]:
        """See `learn_until_done`."""
        self._link.beat("compiling", 0)
        started = time.monotonic()
        if self._lead is None:
            # The leader compiles first, the others take its programs from the cache: those that
            # each of them would tune could differ in the last bit.
            self._reducer.all_gather(np.zeros(1, np.float32))
        state = self._first_state()
        self._update.compile(state, *self._example())
        if self._lead is not None:
            self._reducer.all_gather(np.zeros(1, np.float32))
        pack = jax.jit(lambda state: pack_weights(acting_weights(self._learner, state)))
        first = np.asarray(pack(state))
        compile_s = time.monotonic() - started
        self._link.beat("ready", 0)
        self._check_equal(state)  # And so all trainers have compiled.
        if self._lead is None:
            return {"status": self._loop(state), "updates": self._updates}
        try:
            self._lead.start(first, self._version, self._env_steps)
            status = self._loop(state)
        finally:
            self._lead.close()
        return self._lead.outcome(status, compile_s)

    def _first_state(self) -> LearnerState:
        # The same key as synchronous training uses: the same first policy.
        key = jax.random.split(jax.random.key(self._config.seed))[0]
        obs_size = self._env.spec.obs_size
        state = jax.jit(lambda k: init_learner(self._learner, obs_size, k))(key)
        resume = self._config.run.resume
        if resume is not None:
            self._env_steps = CheckpointMeta.read(Path(resume)).env_steps
            state = restore_learner(Path(resume), state)
        self._version = int(state.iteration)
        return state

    def _loop(self, state: LearnerState) -> str:
        """Returns the status for the outcome."""
        while True:
            batch, waited_s = self._receive()
            tally = self._meet(batch, waited_s)
            started = time.monotonic()
            unrolls = Unrolls(**batch.experience)  # pyright: ignore[reportArgumentType]
            weight = jnp.asarray(self._weights_of(batch) * self._scale(tally))
            state, updated = self._update(state, unrolls, weight)
            weights = np.asarray(updated.weights)
            losses, rates = jax.device_get((updated.losses, updated.rates))
            self._version += 1
            self._updates += 1
            self._env_steps += round(tally.fresh) * self._algo.unroll_length
            self._check_finite(losses)
            is_stopped = tally.stop > 0
            is_last = is_stopped or self._env_steps >= self._config.num_timesteps
            if self._lead is not None:
                self._lead.publish(weights, self._version)
                update_s = time.monotonic() - started
                told = Told(losses, rates, update_s)
                self._lead.record(self._env_steps, self._updates, tally, told, state)
                if not is_last:
                    self._lead.checkpoint_now_and_then(state, self._env_steps, self._updates)
            self._link.beat("running", self._updates)
            if is_last:
                break
        if self._lead is not None:
            self._lead.end(self._env_steps)
        self._check_equal(state)
        # Agents that wait for room may go: the order to end is published by now.
        self._receiver.close()
        if self._lead is not None:
            self._lead.finish(state, self._env_steps, self._updates)
        return "stopped" if is_stopped else "completed"

    def _receive(self) -> tuple[Batch, float]:
        """The next batch with at least one unroll that is fresh enough, and the wait for it."""
        started = since = time.monotonic()
        # At first the agents may still compile.
        times = self._config
        limit_s = times.reduce.timeout_s if self._updates else times.run.start_timeout_s
        while True:
            try:
                batch = self._receiver.receive(self._batch_size, _SLICE_S)
            except CollectiveTimeout as error:
                waited_s = time.monotonic() - since
                if waited_s > limit_s:
                    raise CollectiveTimeout(
                        self._link.gmi, error.missing, "receive", self._updates, limit_s
                    ) from None
            else:
                if self._weights_of(batch).any():
                    return batch, time.monotonic() - started
                self._passed_over += histogram_of(self._version - batch.versions)
                since = time.monotonic()
            if self._updates:
                self._link.beat("running", self._updates)

    def _weights_of(self, batch: Batch) -> npt.NDArray[np.float32]:
        """[B]: 1 for unrolls within the bound of staleness, 0 for others."""
        if self._algo.max_staleness is None:
            return np.ones(self._batch_size, np.float32)
        fresh = self._version - batch.versions <= self._algo.max_staleness
        return fresh.astype(np.float32)

    def _scale(self, tally: Tally) -> np.float32:
        """What a fresh unroll weighs, so that it weighs as much as any other of the job."""
        return np.float32(self._reducer.world_size * self._batch_size / tally.fresh)

    def _meet(self, batch: Batch, waited_s: float) -> Tally:
        """Tells the other trainers of this batch, and hears of theirs."""
        fresh = float(self._weights_of(batch).sum())
        behind = histogram_of(self._version - batch.versions) + self._passed_over
        self._passed_over[:] = 0.0
        head = [self._link.stop_requested, fresh, float(behind.sum()) - fresh, waited_s]
        mine = np.concatenate([head, behind])
        gathered = self._reducer.all_gather(mine.astype(np.float32))
        stop, fresh, stale, _ = (float(x) for x in gathered[:, :4].sum(axis=0))
        return Tally(stop, fresh, stale, float(gathered[:, 3].max()), gathered[:, 4:].sum(axis=0))

    def _example(self) -> tuple[Unrolls, Any]:
        """Shapes of a batch and its weights."""
        steps, size, spec = self._algo.unroll_length, self._batch_size, self._env.spec

        def floats(*shape: int) -> Any:
            return jax.ShapeDtypeStruct(shape, jnp.float32)

        unrolls = Unrolls(
            state=floats(steps, size, spec.obs_size),
            action=floats(steps, size, spec.action_size),
            reward=floats(steps, size),
            done=jax.ShapeDtypeStruct((steps, size, 2), jnp.bool_),  # pyright: ignore[reportArgumentType]
            log_prob=floats(steps, size),
            cut_value=floats(steps, size),
            bootstrap=floats(1, size, spec.obs_size),
        )
        return unrolls, floats(size)

    def _check_finite(self, losses: LossMetrics) -> None:
        if bad := [name for name, x in losses._asdict().items() if not np.isfinite(x)]:
            raise NonFiniteError(
                f"{self._config.env.label}, up to env step {self._env_steps}: "
                f"{', '.join(bad)} of the update is not finite"
            )

    def _check_equal(self, state: LearnerState) -> None:
        digests = self._reducer.all_gather(digest(state.params))
        if different := [r for r in range(len(digests)) if (digests[r] != digests[0]).any()]:
            raise ParameterMismatch(
                f"after {self._env_steps} env steps the parameters of trainers {different} "
                "differ from those of trainer 0"
            )
