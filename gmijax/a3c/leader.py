"""What the first trainer does for all: weights, orders, metrics, checkpoints, the outcome."""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmijax.a3c.board import JobRegisters, Orders, Report
from gmijax.a3c.report import Progress, Reporter, Told
from gmijax.a3c.tally import Tally
from gmijax.checkpoint import finish_checkpoint, save_learner
from gmijax.config import TrainConfig
from gmijax.devices import describe_device
from gmijax.errors import CollectiveTimeout, NonFiniteError
from gmijax.learner import LearnerState
from gmijax.metrics import JsonlSink, MetricsLog, TensorBoardSink
from gmijax.partition.child import ChildLink
from gmijax.results import read_metrics
from gmijax.resume import CheckpointMeta
from gmijax.sim.wrappers import BatchedEnv

_PAUSE_S = 0.02


class Leader:
    """The duties of the first trainer, beside training.

    Args:
      config: of the run.
      env: one of the environments, for its names.
      registers: of the job.
      link: to the controller.
      agents: ids of the GMIs that act, in the order of their reports.
    """

    def __init__(
        self,
        config: TrainConfig,
        env: BatchedEnv,
        registers: JobRegisters,
        link: ChildLink,
        agents: tuple[int, ...],
    ) -> None:
        self._config = config
        self._env = env
        self._registers = registers
        self._link = link
        self._agents = agents
        self._seen = [0] * len(agents)
        self._reports: list[Report | None] = [None] * len(agents)
        self._pending: CheckpointMeta | None = None
        self._checkpoint: Path | None = None
        self._started = 0.0
        self._first_steps = 0
        self._env_steps = 0
        self._updates = 0
        self._wall_s = 0.0
        self._reporter: Reporter | None = None

    def start(self, weights: npt.NDArray[np.float32], version: int, env_steps: int) -> None:
        """Lets the agents begin, with the weights of `version`."""
        run = self._link.run
        history = read_metrics(run.metrics)
        board = TensorBoardSink(run.tensorboard)
        for line in history:  # A resumed run starts with the lines of the one before.
            board.write(line)
        self._reporter = Reporter(
            self._config.env.label,
            MetricsLog((JsonlSink(run.metrics), board)),
            self._env,
            env_steps=env_steps,
            wall_s=history[-1]["wall_s"] if history else 0.0,
        )
        self._started = time.monotonic()
        self._first_steps = self._env_steps = env_steps
        self.publish(weights, version)
        self._order(None, is_ending=False)

    def publish(self, weights: npt.NDArray[np.float32], version: int) -> None:
        """Gives agents new weights [W]; never waits for them."""
        self._registers.weights.publish(weights, tag=version)

    def record(
        self,
        env_steps: int,
        updates: int,
        tally: Tally,
        told: Told,
        state: LearnerState,
    ) -> None:
        """Takes one update into the metrics."""
        self._env_steps, self._updates = env_steps, updates
        reporter = self._require_reporter()
        reporter.add(tally, told)
        if reporter.is_due:
            self._hear()
            reporter.write(self._progress(state))

    def checkpoint_now_and_then(self, state: LearnerState, env_steps: int, updates: int) -> None:
        """Begins a checkpoint when one is due, finishes one when all agents have done theirs.

        Nobody waits: the agents add their environments when they look. Until then no other
        checkpoint is begun.
        """
        every = self._config.run.checkpoint_every
        if self._pending is not None:
            self._hear()
            if not self._missing():
                self._finish_checkpoint()
        elif every and updates % every == 0:
            self._begin_checkpoint(state, env_steps)
            self._order(env_steps, is_ending=False)

    def end(self, env_steps: int) -> None:
        """Tells the agents to add to the last checkpoint and to end."""
        if self._pending is not None:  # It would be given up for this one: see it through.
            self._wait_for_agents()
        self._order(env_steps, is_ending=True)

    def finish(self, state: LearnerState, env_steps: int, updates: int) -> None:
        """Writes the last checkpoint and the last line of metrics."""
        self._wall_s = time.monotonic() - self._started
        self._env_steps, self._updates = env_steps, updates
        self._begin_checkpoint(state, env_steps)
        self._wait_for_agents()
        self._require_reporter().write(self._progress(state))

    def close(self) -> None:
        """Flushes the metrics."""
        if self._reporter is not None:
            self._reporter.close()

    def outcome(self, status: str, compile_s: float) -> dict[str, Any]:
        """The outcome of the job for `result.json`."""
        reporter = self._require_reporter()
        pps, ttop = (_median(rates) for rates in (reporter.pps, reporter.ttop))
        return {
            "status": status,
            "env_steps": self._env_steps,
            "iterations": self._updates,
            "train_wall_s": self._wall_s,
            "compile_s": compile_s,
            "env_steps_per_s": (self._env_steps - self._first_steps) / self._wall_s,
            "step_per_s_inference": pps,
            "step_per_s_train": ttop,
            "pps": pps,
            "ttop": ttop,
            "staleness": reporter.staleness(),
            "bytes_per_s": _median(reporter.bytes_per_s),
            "dropped": reporter.dropped,
            "final_return": reporter.last_return,
            "overflow_steps": reporter.overflows.steps,
            "checkpoint": str(self._checkpoint) if self._checkpoint else None,
            "device": describe_device(),
        }

    def _progress(self, state: LearnerState) -> Progress:
        return Progress(
            env_steps=self._env_steps,
            reports=tuple(report for report in self._reports if report is not None),
            learning_rate=float(state.learning_rate),
            noise_std=float(jnp.mean(jnp.exp(state.params.log_std))),
        )

    def _order(self, checkpoint: int | None, *, is_ending: bool) -> None:
        self._registers.orders.publish(Orders(checkpoint, is_ending).pack())

    def _hear(self) -> None:
        for index, register in enumerate(self._registers.reports):
            if (snapshot := register.read(self._seen[index])) is not None:
                self._seen[index] = snapshot.count
                self._reports[index] = Report.unpack(snapshot.values)

    def _missing(self) -> list[int]:
        """Agents that have not added to the pending checkpoint."""
        wanted = self._pending.env_steps if self._pending else None
        theirs = [None if report is None else report.checkpoint for report in self._reports]
        return [gmi for gmi, has in zip(self._agents, theirs, strict=True) if has != wanted]

    def _begin_checkpoint(self, state: LearnerState, env_steps: int) -> None:
        if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(state.params)):
            raise NonFiniteError(
                f"{self._config.env.label}: parameters are not finite after {env_steps} env "
                "steps; nothing was saved"
            )
        algo = self._config.algo
        save_learner(self._link.run, env_steps, state)
        self._pending = CheckpointMeta(
            env=self._config.env.label,
            algo=algo.name,
            env_steps=env_steps,
            num_gmis=len(self._agents),
            num_envs=self._config.envs_per_gmi,
            hidden=(algo.policy_hidden_layer_sizes, algo.value_hidden_layer_sizes),
            impl=self._config.physics.impl,
            mean_return=self._require_reporter().last_return,
        )

    def _wait_for_agents(self) -> None:
        """Finishes the pending checkpoint when all agents have added to it.

        Raises:
          CollectiveTimeout: some did not; nothing gets the checkpoint's name.
        """
        limit_s = self._config.reduce.timeout_s
        started = time.monotonic()
        self._hear()
        while missing := self._missing():
            if time.monotonic() - started > limit_s:
                raise CollectiveTimeout(
                    self._link.gmi, tuple(missing), "checkpoint", self._updates, limit_s
                )
            self._link.beat("running", self._updates)
            time.sleep(_PAUSE_S)
            self._hear()
        self._finish_checkpoint()

    def _finish_checkpoint(self) -> None:
        assert self._pending is not None
        self._checkpoint = finish_checkpoint(
            self._link.run, self._pending, self._config.run.keep_checkpoints
        )
        self._pending = None

    def _require_reporter(self) -> Reporter:
        assert self._reporter is not None, "start comes first"
        return self._reporter


def _median(rates: list[float]) -> float | None:
    # The first one holds the start of the pipeline.
    return statistics.median(rates[1:] or rates) if rates else None
