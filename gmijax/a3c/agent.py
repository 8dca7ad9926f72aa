"""The role of a serving GMI: simulator and agent in one.

It acts with the newest published weights, sends the experience, and acts again. It waits for
trainers only while the channel is full. It also takes newer weights in the middle of an unroll:
the fresher its experience, the fewer steps a policy needs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
import numpy.typing as npt

from gmijax.a3c.job_registers import AgentCommand, AgentReport, JobRegisters
from gmijax.a3c.rollout import UnrollPrograms, num_counts
from gmijax.a3c.targets import Unrolls
from gmijax.channels.sender import Sender
from gmijax.clock import running_s
from gmijax.config import A3cConfig, TrainConfig
from gmijax.devices import describe_device
from gmijax.errors import CollectiveTimeout, PipeClosed
from gmijax.learning.checkpoint import save_envs
from gmijax.learning.learner import (
    ActingWeights,
    acting_weights,
    init_learner,
    make_learner,
    unpack_weights,
)
from gmijax.learning.start import first_envs
from gmijax.learning.unroll import Counts
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.supervise.child import ChildLink
from gmijax.types import Array

_PAUSE_S = 0.02
_POLL_S = 0.0002
_SLICE_S = 0.5
"""Longest wait for space before the agent looks for commands again."""


class _PendingRollout(NamedTuple):
    """An unroll that is being computed: what it will be, and the first policy that makes it."""

    experience: Unrolls
    stats: Array
    version: int


@dataclass
class Agent:
    """One serving GMI, number `index` of the agents; `trainers` are named in errors."""

    config: TrainConfig
    env: BatchedEnv
    index: int
    trainers: tuple[int, ...]
    registers: JobRegisters
    sender: Sender
    link: ChildLink

    def __post_init__(self) -> None:
        assert isinstance(self.config.algo, A3cConfig)
        self._algo = self.config.algo
        self._learner = make_learner(self.env.spec, self._algo)
        self._report = AgentReport.of_nothing(num_counts(self.env))
        self._orders_seen = 0
        self._orders = AgentCommand(None, is_ending=False)
        self._weights_seen = 0
        self._version = 0
        self._unrolls = 0
        self._wait_s = 0.0

    def run(self) -> dict[str, Any]:
        """Acts until the leading trainer ends the job.

        Returns:
          The outcome for `result.json`.

        Raises:
          CollectiveTimeout: trainers do not start, or take nothing any more.
        """
        self.link.beat("compiling", 0)
        started = time.monotonic()
        learner, obs_size = self._learner, self.env.spec.obs_size
        # Of the right shapes; those to act with are read later. Without the learning rate, so that
        # jobs that differ in it alone have the same programs.
        start = jax.jit(lambda key: acting_weights(learner, init_learner(learner, obs_size, key)))
        weights = start(jax.random.key(0))
        env_state = first_envs(self.env, self.config, self.index, gmi=self.link.gmi)
        num_pieces = self._algo.pieces_per_unroll
        num_steps = self._algo.unroll_length // num_pieces
        program = UnrollPrograms(
            *(self.env, self._learner.networks, num_steps, num_pieces, weights, env_state),
            stays=self.sender.on_device,
        )
        compile_s = time.monotonic() - started - self.link.start_s["waiting"]
        self.link.beat("ready", 0)
        self._wait_for_start()
        started = time.monotonic()
        self._loop(program, weights, env_state)
        return {
            "status": "completed",
            "env_steps": int(self._report.env_steps),
            "unrolls": self._unrolls,
            "wall_s": time.monotonic() - started,
            "send_s": self._report.send_s,
            "wait_s": self._wait_s,
            "compile_s": compile_s,
            "device": describe_device(),
        }

    def _wait_for_start(self) -> None:
        """Returns when the leading trainer has written its first orders and weights."""
        limit_s = self.config.run.start_timeout_s
        started = running_s()
        while not self._look():
            if running_s() - started > limit_s:
                raise self._late("the start", limit_s)
            time.sleep(_PAUSE_S)

    def _loop(
        self, programs: UnrollPrograms, weights: ActingWeights, env_state: BatchState
    ) -> None:
        pending: _PendingRollout | None = None
        unpack = jax.jit(lambda packed: unpack_weights(weights, packed))
        while not self._handle_command(env_state):
            weights = self._newest(weights, unpack)
            version = self._version  # Of the oldest weights that make this unroll.
            pieces: list[tuple[Unrolls, Counts]] = []
            for index in range(self._algo.pieces_per_unroll):
                if index > 1:  # One piece runs and one waits: more would act with older weights.
                    jax.block_until_ready(pieces[index - 2])
                if index > 0:
                    weights = self._newest(weights, unpack)
                env_state, made = programs.piece(weights, env_state)
                pieces.append(made)
                # While the device computes this unroll, the one before is sent.
                if index == 0 and pending is not None:
                    self._send(pending, env_state)
            pending = _PendingRollout(*programs.join(pieces), version)
        self._publish()

    def _newest(
        self, weights: ActingWeights, unpack: Callable[[npt.NDArray[np.float32]], ActingWeights]
    ) -> ActingWeights:
        """The newest weights published; `weights` if there are no newer ones."""
        if (snapshot := self.registers.weights.read(self._weights_seen)) is None:
            return weights
        self._weights_seen, self._version = snapshot.count, snapshot.tag
        return unpack(snapshot.values.view(np.float32))

    def _send(self, unroll: _PendingRollout, env_state: BatchState) -> None:
        unrolls = unroll.experience
        if not self.sender.on_device:
            unrolls = jax.tree.map(np.asarray, unrolls)
        stats = np.asarray(unroll.stats, np.float64)
        started = time.monotonic()
        if not self._hand_over(unrolls, unroll.version, env_state):
            return
        sender, occupancy = self.sender, self.sender.occupancy()
        if not sender.least_occupancy():  # A trainer has nothing to do: it need not wait for more.
            sender.flush()
        self._unrolls += 1
        self._report = self._report._replace(
            env_steps=self._report.env_steps + unrolls.reward.size,
            bytes_sent=float(sender.num_bytes),
            send_s=self._report.send_s + time.monotonic() - started,
            wait_s=self._wait_s,
            occupancy=occupancy,
            stats=self._report.stats + stats,
        )
        self._publish()
        self.link.beat("running", self._unrolls)

    def _hand_over(self, unrolls: Unrolls, version: int, env_state: BatchState) -> bool:
        """Sends an unroll; False if the job ends and no trainer needs it any more."""
        limit_s, started = self.config.reduce.timeout_s, running_s()
        try:
            while not self._offer(unrolls, version, env_state):
                # Trainers that wait for a checkpoint free no space until it is complete.
                if self._handle_command(env_state):
                    return False
                if running_s() - started > limit_s:
                    raise self._late("send", limit_s)
                self.link.beat("running", self._unrolls)
        except PipeClosed:
            if not self._handle_command(env_state):
                raise
            return False
        return True

    def _offer(self, unrolls: Unrolls, version: int, env_state: BatchState) -> bool:
        """Whether the channels took an unroll within a moment; waits on an idle device count."""
        if self._is_ahead(unrolls, env_state):
            return False
        costs, before_s = _is_idle(env_state), self.sender.waited_s
        is_sent = self.sender.send(unrolls, version, _SLICE_S)
        if costs:
            self._wait_s += self.sender.waited_s - before_s
        return is_sent

    def _is_ahead(self, unrolls: Unrolls, env_state: BatchState) -> bool:
        """Waits a moment while `max_ahead` unrolls wait for every trainer; whether they still do.

        More of them in the channel would only make experience older.
        """
        size = sum(array.nbytes for array in unrolls)
        most = (self._algo.max_ahead - 0.5) * size / self.config.channel.capacity_bytes
        deadline_s = time.monotonic() + _SLICE_S
        while self.sender.least_occupancy() > most:
            costs, now_s = _is_idle(env_state), time.monotonic()
            if now_s > deadline_s:
                return True
            time.sleep(_POLL_S)
            if costs:
                self._wait_s += time.monotonic() - now_s
        return False

    def _handle_command(self, env_state: BatchState) -> bool:
        """Adds to the checkpoint that is wanted, if any; returns whether the job ends."""
        self._look()
        steps = self._orders.checkpoint
        if steps is not None and steps != self._report.checkpoint:
            save_envs(self.link.run, steps, self.link.gmi, env_state)
            self._report = self._report._replace(checkpoint=steps)
            self._publish()
        return self._orders.is_ending

    def _look(self) -> bool:
        """Takes up new orders; returns whether there ever were any."""
        if (snapshot := self.registers.orders.read(self._orders_seen)) is not None:
            self._orders_seen, self._orders = snapshot.count, AgentCommand.unpack(snapshot.values)
        return self._orders_seen > 0

    def _publish(self) -> None:
        self.registers.reports[self.index].publish(self._report.pack())

    def _late(self, what: str, limit_s: float) -> CollectiveTimeout:
        return CollectiveTimeout(self.link.gmi, self.trainers, what, self._unrolls, limit_s)


def _is_idle(env_state: BatchState) -> bool:
    """Whether the device has computed all that it was given: then a wait costs time."""
    return env_state.return_sum.is_ready()  # pyright: ignore[reportAttributeAccessIssue]
