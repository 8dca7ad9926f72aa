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

from gmijax.a3c.a3c import make_update
from gmijax.a3c.fresh_batches import FreshBatches
from gmijax.a3c.job_registers import JobRegisters
from gmijax.a3c.leader import Leader
from gmijax.a3c.targets import Unrolls
from gmijax.channels.batcher import Batcher
from gmijax.collectives.interface import Communicator
from gmijax.config import A3cConfig, TrainConfig
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
        self._batches = FreshBatches(self.config, self.receiver, self.comm, self.link)

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
            batch = self._batches.take(self._version, self._updates)
            counts, started = batch.counts, time.monotonic()
            state, _, updated = self._update(state, (batch.unrolls, jnp.asarray(batch.weights)))
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
        # Agents that wait for space may end: the command to do so is published by now.
        self.receiver.close()
        if leader is not None:
            leader.finish(state)
        self._trace.close()  # Last: a job that is to end has little time to save.
        return "stopped" if is_stopped else "completed"

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
