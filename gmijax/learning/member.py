"""The training runs of a loop: most jobs have one, several of a sweep can share a program.

They differ in seed and learning rate alone. Their learners and environments are stacked along a
leading axis [K], and `jax.vmap` makes one program of their K iterations, whose kernels are K times
as large. Each run has its own folder.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.config import TrainConfig
from gmijax.errors import NonFiniteError, ReportedError
from gmijax.learning.algorithm import IterationMetrics
from gmijax.learning.checkpoint import (
    checkpoint_meta,
    require_finite,
    restore_replay,
    save_episodes,
)
from gmijax.learning.checkpoint_saver import CheckpointPart
from gmijax.learning.evaluator import Evaluation
from gmijax.learning.learner import TrainState
from gmijax.learning.policy_file import save_policy
from gmijax.learning.saved_arrays import on_host
from gmijax.learning.start import first_window, replay_goes_on
from gmijax.learning.training_log import TrainingLog, UpdateMetrics
from gmijax.runs.folder import RunPaths, write_json
from gmijax.types import PyTree


class Member:
    """One of the runs.

    Attributes:
      config: of the run.
      run: its run folder.
      error: why it has ended before the others, None while it runs.
    """

    def __init__(self, config: TrainConfig, run: RunPaths) -> None:
        self.config, self.run = config, run
        self.error: NonFiniteError | None = None
        self._log: TrainingLog | None = None

    @property
    def log(self) -> TrainingLog:
        """Its lines of metrics."""
        assert self._log is not None
        return self._log

    def open_log(
        self, env_steps: int, limit_steps: int, gmi: int, num_gmis: int, *, is_leader: bool
    ) -> None:
        """Before the first line; only the leader's are written. See `first_window`."""
        name = self.config.env.label
        if not is_leader:
            self._log = TrainingLog(name, (), env_steps)
            return
        window = first_window(self.config, limit_steps, gmi, num_gmis)
        self._log = TrainingLog.open(name, self.run, env_steps, window)

    def part(
        self,
        env_steps: int,
        num_gmis: int,
        state: TrainState | None,
        env_state: PyTree | None,
        replay: PyTree | None,
        evaluation: Evaluation | None,
    ) -> CheckpointPart:
        """What a checkpoint holds of it; see `CheckpointPart`."""
        config, run, episodes = self.config, self.run, self.log.episodes()
        evaluated = None if evaluation is None else evaluation.mean_return
        meta = checkpoint_meta(config, env_steps, num_gmis, self.log.standing(), evaluated)

        def save_more(host_state: TrainState) -> None:
            save_policy(run, env_steps, config.env, config.algo, host_state)
            save_episodes(run, env_steps, config, episodes)

        return CheckpointPart(run, meta, state, env_state, save_more, replay)

    def median_rate(self, steps_per_iteration: int) -> float | None:
        """Environment steps per second of its median iteration."""
        # The first iteration fills caches and pools, and its metrics come late.
        steady = self.log.line_s[1:] or self.log.line_s
        return steps_per_iteration / statistics.median(steady) if steady else None


class Members:
    """All runs of a loop.

    A number that is not finite ends the only run by an error. Of several runs it ends that one
    alone, which leaves an `error.json`.

    Args:
      members: the runs, from the same step on.
      gmi: that trains them; of several runs the only one.
    """

    def __init__(self, members: Sequence[Member], gmi: int) -> None:
        self._members, self._gmi = tuple(members), gmi
        self.first = members[0]

    @property
    def is_one(self) -> bool:
        """Whether there is one run, whose arrays have no axis of runs."""
        return len(self._members) == 1

    @property
    def count(self) -> int:
        """How many runs there are."""
        return len(self._members)

    @property
    def going_on(self) -> list[Member]:
        """Those that have not failed."""
        return [member for member in self._members if member.error is None]

    def stacked(self, make: Callable[[Member], Any]) -> Any:
        """What `make` gives for each run, with an axis of runs where there are several."""
        made = [make(member) for member in self._members]
        return made[0] if self.is_one else _stack(made)

    def each(self, make: Callable[..., Any]) -> Callable[..., Any]:
        """`make` for arguments with an axis of runs where there are several."""
        return make if self.is_one else jax.vmap(make)

    def restored_replay(self, template: PyTree, gmi: int, num_gmis: int) -> PyTree | None:
        """What the checkpoints that all runs resume from hold of `template`, in the host's memory.

        With an axis of runs where there are several, as `template` has; None where a run begins
        without.
        """
        configs = [member.config for member in self._members]
        if template is None or not all(replay_goes_on(one, gmi, num_gmis) for one in configs):
            return None
        own = template if self.is_one else jax.eval_shape(partial(_row, number=0), template)
        found = [restore_replay(Path(str(one.run.resume)), gmi, own) for one in configs]
        return found[0] if self.is_one else jax.tree.map(lambda *rows: np.stack(rows), *found)

    def report(
        self,
        env_steps: int,
        metrics: IterationMetrics,
        times: Mapping[str, float],
        evaluation: Evaluation | None,
    ) -> None:
        """Waits for the iteration that ended at `env_steps`, and writes a line for each run."""
        host = jax.device_get(metrics)
        for number, member in enumerate(self._members):
            own = host if self.is_one else _row(host, number)
            self._try(member, partial(report, member.log, env_steps, own, times, evaluation))

    def parts(
        self,
        env_steps: int,
        num_gmis: int,
        state: TrainState,
        learned: PyTree,
        env_state: PyTree | None,
        replay: PyTree | None,
        evaluation: Evaluation | None,
        *,
        is_leader: bool,
    ) -> list[CheckpointPart]:
        """What a checkpoint holds of each run whose weights, `learned`, are finite.

        All arguments may be donated afterwards, but for `replay`: of that there is no second copy
        where the device is the host.
        """
        learned = jax.device_get(learned)
        learners = on_host(state) if is_leader else None
        envs = on_host(env_state)  # None stays None.
        replays = jax.tree.map(np.asarray, replay)
        parts = []
        for number, member in enumerate(self._members):
            own, weights = (learners, envs, replays), learned
            if not self.is_one:
                own, weights = _row((own, learned), number)
            learner, own_envs, own_replay = own
            self._try(member, partial(require_finite, weights, member.config.env.label, env_steps))
            if member.error is None:
                part = member.part(env_steps, num_gmis, learner, own_envs, own_replay, evaluation)
                parts.append(part)
        return parts

    def close(self) -> None:
        """Flushes the logs."""
        for member in self._members:
            member.log.close()

    def _try(self, member: Member, act: Callable[[], None]) -> None:
        if member.error is not None:
            return
        try:
            act()
        except NonFiniteError as error:
            if self.is_one:
                raise
            member.error = error
            reported = ReportedError(type(error).__name__, str(error), str(error), ())
            write_json(member.run.gmi(self._gmi).error, reported._asdict())


def report(
    log: TrainingLog,
    env_steps: int,
    metrics: IterationMetrics,
    times: Mapping[str, float],
    evaluation: Evaluation | None = None,
) -> None:
    """Writes the line of the iteration that ended at `env_steps`.

    Args:
      log: gets the line.
      env_steps: learnt from by then.
      metrics: of the iteration; waits for them where they are on the device.
      times: seconds by name, written as they are.
      evaluation: after the iteration, None if there was none.

    Raises:
      NonFiniteError: see `TrainingLog.write`.
    """
    host: Any = jax.tree.map(float, jax.device_get(metrics))
    learnt = UpdateMetrics(host.losses._asdict(), host.figures, host.rates)
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


def _row(tree: Any, number: int) -> Any:
    """The part of one of several runs."""
    return jax.tree.map(lambda leaf: leaf[number], tree)


@jax.jit
def _stack(trees: list[Any]) -> Any:
    """One tree whose leaves have a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
