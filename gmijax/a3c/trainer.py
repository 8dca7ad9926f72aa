"""The role of a training GMI: takes experience, learns, publishes weights.

All trainers make the same updates; the first leads them: it publishes the weights, gives the
agents their orders, writes metrics and the shared part of checkpoints.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmijax.a3c.a3c import make_update
from gmijax.a3c.job_registers import JobRegisters
from gmijax.a3c.leader import Leader
from gmijax.a3c.report import MAX_COUNTED, BatchCounts, histogram_of
from gmijax.a3c.targets import Unrolls
from gmijax.channels.batcher import Batcher
from gmijax.channels.experience import Rollouts
from gmijax.clock import running_s
from gmijax.collectives.interface import Communicator
from gmijax.config import A3cConfig, TrainConfig
from gmijax.errors import CollectiveTimeout
from gmijax.learning.checkpoint import require_equal
from gmijax.learning.iteration_trace import IterationTrace
from gmijax.learning.learner import (
    TrainState,
    acting_weights,
    init_learner,
    make_learner,
    pack_weights,
)
from gmijax.learning.physics_health import check_losses
from gmijax.learning.start import first_state
from gmijax.sim.wrappers import BatchedEnv
from gmijax.supervise.child import ChildLink

_SLICE_S = 0.5
"""Longest wait for experience before the trainer says that it is alive."""


@dataclass
class Trainer:
    """One training GMI; `env` is not stepped, it is there for its sizes.

    `receiver` gives it the experience of `agents`, and `comm` is among the trainers.
    """

    config: TrainConfig
    env: BatchedEnv
    agents: tuple[int, ...]
    registers: JobRegisters
    receiver: Batcher
    comm: Communicator
    link: ChildLink

    def __post_init__(self) -> None:
        assert isinstance(self.config.algo, A3cConfig)
        self._algo = self.config.algo
        self._batch_size = self._algo.batch_of(self.config.envs_per_gmi)
        self._learner = make_learner(self.env.spec, self._algo)
        self._update = make_update(self._learner, self.comm)
        self._env_steps = 0
        self._updates = 0
        traced, leads = self.config.run.profiled, self.comm.rank == 0
        self._trace = IterationTrace(traced, self.link.run.profile, is_written=leads)
        self._version = 0
        self._passed_over = np.zeros(MAX_COUNTED + 1, np.float32)

    def run(self) -> dict[str, Any]:
        """Learns until `num_timesteps` are consumed or the controller asks for an end.

        Returns:
          The outcome for `result.json`; of the leader, that of the job.

        Raises:
          NonFiniteError: simulation or learning produced NaN or infinity.
          ParameterMismatch: the trainers' parameters differ.
          CollectiveError: another GMI is gone or stuck.
        """
        self.link.beat("compiling", 0)
        started = time.monotonic()
        leads = self.comm.rank == 0
        # The same key as synchronous training uses: the same first policy.
        state, self._env_steps = first_state(
            init_learner, self._learner, self.env.spec.obs_size, self.config
        )
        self._version = int(state.iteration)
        self._update.trace((), state, self._example())
        self._update.compile()
        pack = jax.jit(lambda state: pack_weights(acting_weights(self._learner, state)))
        first = np.asarray(pack(state))
        compile_s = time.monotonic() - started - self.link.start_s["waiting"]
        self.link.beat("ready", 0)
        # And so all trainers have compiled.
        require_equal(self.comm, self.link.gmi, state.params, self._env_steps)
        if not leads:
            return {"status": self._loop(state, None), "updates": self._updates}
        leader = Leader(
            self.config, self.env, self.registers, self.link, self.agents, self._env_steps
        )
        try:
            leader.start(first, self._version)
            status = self._loop(state, leader)
        finally:
            leader.close()
        return leader.outcome(status, compile_s, self._trace.outcome()).to_dict()

    def _loop(self, state: TrainState, leader: Leader | None) -> str:
        """Returns the status for the outcome."""
        while True:
            self._trace.begin(self._updates + 1, self._update.wait)
            batch, waited_s = self._receive()
            counts = self._meet(batch, waited_s)
            started = time.monotonic()
            unrolls = Unrolls(**batch.experience)  # pyright: ignore[reportArgumentType]
            weight = jnp.asarray(self._weights_of(batch) * self._scale(counts))
            state, _, updated = self._update(state, (unrolls, weight))
            self._update.wait()
            weights = np.asarray(updated.weights)
            updated = jax.device_get(updated._replace(weights=None))
            self._version += 1
            self._updates += 1
            self._env_steps += round(counts.fresh) * self._algo.unroll_length
            where = f"{self.config.env.label}, up to env step {self._env_steps}"
            check_losses(where, updated.losses._asdict())
            is_stopped = counts.stop > 0
            is_last = is_stopped or self._env_steps >= self.config.num_timesteps
            if leader is not None:
                leader.publish(weights, self._version)
                update_s = time.monotonic() - started
                leader.record(self._env_steps, self._updates, counts, updated, update_s, state)
                if not is_last:
                    leader.checkpoint_now_and_then(state)
            self._trace.end(self._updates, self._update.wait)
            self.link.beat("running", self._updates)
            if is_last:
                break
        if leader is not None:
            leader.end()
        require_equal(self.comm, self.link.gmi, state.params, self._env_steps)
        # Agents that wait for room may go: the order to end is published by now.
        self.receiver.close()
        if leader is not None:
            leader.finish(state)
        self._trace.close()  # Last: a job that is told to end has little time to save.
        return "stopped" if is_stopped else "completed"

    def _receive(self) -> tuple[Rollouts, float]:
        """The next batch with at least one unroll that is fresh enough, and the wait for it."""
        started, since = time.monotonic(), running_s()
        # At first the agents may still compile.
        times = self.config
        limit_s = times.reduce.timeout_s if self._updates else times.run.start_timeout_s
        while True:
            try:
                batch = self.receiver.receive(self._batch_size, _SLICE_S)
            except CollectiveTimeout as error:
                waited_s = running_s() - since
                if waited_s > limit_s:
                    raise CollectiveTimeout(
                        self.link.gmi, error.missing, "receive", self._updates, limit_s
                    ) from None
            else:
                if self._weights_of(batch).any():
                    return batch, time.monotonic() - started
                self._passed_over += histogram_of(self._version - batch.versions)
                since = running_s()
            if self._updates:
                self.link.beat("running", self._updates)

    def _weights_of(self, batch: Rollouts) -> npt.NDArray[np.float32]:
        """[B]: 1 for unrolls within the bound of staleness, 0 for others."""
        if self._algo.max_staleness is None:
            return np.ones(self._batch_size, np.float32)
        fresh = self._version - batch.versions <= self._algo.max_staleness
        return fresh.astype(np.float32)

    def _scale(self, counts: BatchCounts) -> np.float32:
        """Weight of a fresh unroll, equal to that of any other of the job."""
        return np.float32(self.comm.world_size * self._batch_size / counts.fresh)

    def _meet(self, batch: Rollouts, waited_s: float) -> BatchCounts:
        """Tells the other trainers of this batch, and hears of theirs."""
        fresh = float(self._weights_of(batch).sum())
        behind = histogram_of(self._version - batch.versions) + self._passed_over
        self._passed_over[:] = 0.0
        head = [self.link.stop_requested, fresh, float(behind.sum()) - fresh, waited_s]
        mine = np.concatenate([head, behind])
        gathered = self.comm.all_gather(mine.astype(np.float32))
        stop, fresh, stale, _ = (float(x) for x in gathered[:, :4].sum(axis=0))
        return BatchCounts(
            stop, fresh, stale, float(gathered[:, 3].max()), gathered[:, 4:].sum(axis=0)
        )

    def _example(self) -> tuple[Unrolls, Any]:
        """Shapes of a batch and its weights."""
        steps, size, spec = self._algo.unroll_length, self._batch_size, self.env.spec

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
