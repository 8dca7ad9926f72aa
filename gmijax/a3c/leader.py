"""Duties of the first trainer: weights, orders, metrics, checkpoints, the outcome."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gmijax.a3c.a3c import UpdateResult
from gmijax.a3c.job_registers import AgentCommand, AgentReport, JobRegisters
from gmijax.a3c.report import BatchCounts, Reporter
from gmijax.clock import running_s
from gmijax.config import TrainConfig
from gmijax.devices import describe_device
from gmijax.errors import CollectiveTimeout
from gmijax.learning.checkpoint import (
    checkpoint_meta,
    finish_checkpoint,
    require_finite,
    save_episodes,
    save_learner,
)
from gmijax.learning.learner import TrainState, policy_figures
from gmijax.learning.policy_file import save_policy
from gmijax.learning.start import first_window
from gmijax.learning.training_log import TrainingLog
from gmijax.runs.result import TrainResult
from gmijax.sim.wrappers import BatchedEnv
from gmijax.supervise.child import ChildLink

_PAUSE_S = 0.02


@dataclass
class Leader:
    """The duties of the first trainer, beside training; `agents` are in the order of reports."""

    config: TrainConfig
    env: BatchedEnv
    registers: JobRegisters
    link: ChildLink
    agents: tuple[int, ...]
    env_steps: int

    def __post_init__(self) -> None:
        self._seen = [0] * len(self.agents)
        self._reports: list[AgentReport | None] = [None] * len(self.agents)
        self._pending: int | None = None  # Environment steps of a checkpoint.
        self._checkpoint: Path | None = None
        limit_steps = self.env.spec.episode_length * self.config.envs_per_gmi * len(self.agents)
        window = first_window(self.config, limit_steps, self.agents[0], None)
        self._log = TrainingLog.open(self.config.env.label, self.link.run, self.env_steps, window)
        self._reporter = Reporter(self._log, self.env, self.env_steps)
        self._started = time.monotonic()
        self._first_steps = self.env_steps
        self._updates = 0
        self._wall_s = 0.0

    def start(self, weights: npt.NDArray[np.float32], version: int) -> None:
        """Lets the agents begin, with the weights of `version`."""
        self.publish(weights, version)
        self._send_command(None, is_ending=False)

    def publish(self, weights: npt.NDArray[np.float32], version: int) -> None:
        """Gives agents new weights [W]; never waits for them."""
        self.registers.weights.publish(weights, tag=version)

    def record(
        self,
        env_steps: int,
        updates: int,
        counts: BatchCounts,
        updated: UpdateResult,
        update_s: float,
        state: TrainState,
    ) -> None:
        """Takes one update, of `update_s` seconds, into the metrics."""
        self.env_steps, self._updates = env_steps, updates
        self._reporter.add(counts, updated, update_s)
        if self._reporter.is_due:
            self._read_reports()
            self._write_line(state)

    def checkpoint_now_and_then(self, state: TrainState) -> None:
        """Begins a checkpoint when one is due, finishes one when all agents have done theirs.

        Nothing waits: the agents add their environments when they look. Until then no other
        checkpoint is begun.
        """
        every = self.config.run.checkpoint_every
        if self._pending is not None:
            self._read_reports()
            if not self._missing():
                self._finish_checkpoint()
        elif every and self._updates % every == 0:
            self._begin_checkpoint(state)
            self._send_command(self.env_steps, is_ending=False)

    def end(self) -> None:
        """Makes the agents add to the last checkpoint and end."""
        if self._pending is not None:  # It would be given up for this one: see it through.
            self._wait_for_agents()
            self._finish_checkpoint()
        self._send_command(self.env_steps, is_ending=True)

    def finish(self, state: TrainState) -> None:
        """Writes the last checkpoint and the last line of metrics."""
        self._wall_s = time.monotonic() - self._started
        self._begin_checkpoint(state)
        self._wait_for_agents()
        self._write_line(state)  # Its episodes go into the checkpoint.
        self._finish_checkpoint()

    def close(self) -> None:
        """Flushes the metrics."""
        self._log.close()

    def outcome(
        self, status: str, compile_s: float, profile: Mapping[str, Any] | None
    ) -> TrainResult:
        """The outcome of the job; `profile` is that of the trace."""
        reporter = self._reporter
        pps, ttop = (_median(rates) for rates in (reporter.pps, reporter.ttop))
        return TrainResult(
            status=status,
            env_steps=self.env_steps,
            iterations=self._updates,
            train_wall_s=self._wall_s,
            compile_s=compile_s,
            env_steps_per_s=(self.env_steps - self._first_steps) / self._wall_s,
            step_per_s_inference=pps,
            step_per_s_train=ttop,
            pps=pps,
            ttop=ttop,
            staleness=reporter.staleness(),
            bytes_per_s=_median(reporter.bytes_per_s),
            final_return=self._log.last_return,
            overflow_steps=self._log.overflows.steps,
            checkpoint=str(self._checkpoint) if self._checkpoint else None,
            device=describe_device(),
            profile=profile,
        )

    def _write_line(self, state: TrainState) -> None:
        self._reporter.write(
            self.env_steps,
            [report for report in self._reports if report is not None],
            {name: float(value) for name, value in policy_figures(state).items()},
        )

    def _send_command(self, checkpoint: int | None, *, is_ending: bool) -> None:
        self.registers.orders.publish(AgentCommand(checkpoint, is_ending).pack())

    def _read_reports(self) -> None:
        for index, register in enumerate(self.registers.reports):
            if (snapshot := register.read(self._seen[index])) is not None:
                self._seen[index] = snapshot.count
                self._reports[index] = AgentReport.unpack(snapshot.values)

    def _missing(self) -> list[int]:
        """Agents that have not added to the pending checkpoint."""
        theirs = [None if report is None else report.checkpoint for report in self._reports]
        return [gmi for gmi, has in zip(self.agents, theirs, strict=True) if has != self._pending]

    def _begin_checkpoint(self, state: TrainState) -> None:
        require_finite(state.params, self.config.env.label, self.env_steps)
        save_learner(self.link.run, self.env_steps, state)
        save_policy(self.link.run, self.env_steps, self.config.env, self.config.algo, state)
        self._pending = self.env_steps

    def _wait_for_agents(self) -> None:
        """Returns when all agents have added to the pending checkpoint.

        Raises:
          CollectiveTimeout: some did not; nothing gets the checkpoint's name.
        """
        limit_s = self.config.reduce.timeout_s
        started = running_s()
        self._read_reports()
        while missing := self._missing():
            if running_s() - started > limit_s:
                raise CollectiveTimeout(
                    self.link.gmi, tuple(missing), "checkpoint", self._updates, limit_s
                )
            self.link.beat("running", self._updates)
            time.sleep(_PAUSE_S)
            self._read_reports()

    def _finish_checkpoint(self) -> None:
        assert self._pending is not None
        run, log, config = self.link.run, self._log, self.config
        save_episodes(run, self._pending, config, log.episodes())
        meta = checkpoint_meta(config, self._pending, len(self.agents), log.standing())
        self._checkpoint = finish_checkpoint(run, meta, config.run.keep_checkpoints)
        self._pending = None


def _median(rates: list[float]) -> float | None:
    # The first one holds the start of the pipeline.
    return statistics.median(rates[1:] or rates) if rates else None
