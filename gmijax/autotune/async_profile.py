"""When a profile of an asynchronous job can be read, and its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

from gmijax.autotune.grid import Measured
from gmijax.config import A3cConfig, TrainConfig
from gmijax.config.search import PROFILED_ITERATIONS
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths
from gmijax.runs.history import read_metrics
from gmijax.supervise.job_kinds import groups_of
from gmijax.supervise.watched_gmi import GmiStatus

FEWEST_LINES: Final = 3
"""Lines of metrics that a profile goes by, each of half a second or of one batch."""

MOST_IDLE: Final = 0.95
"""Agents that wait longer than this part of their time do not show how fast they could be."""

Line = Mapping[str, Any]


class ProfileWindow:
    """Whether a profile can be read: enough was done since its channels had filled.

    Agents compile for different times, and until the channels are full they never wait: nothing
    that is counted before is of a long job.
    """

    def __init__(self, config: TrainConfig, plan: Plan, run: RunPaths) -> None:
        agents, trainers = groups_of(plan)
        self._agents = agents.gmis
        assert isinstance(config.algo, A3cConfig)
        # Those that may wait for every trainer, one on its way, and one that is being made.
        self._unrolls = config.algo.max_ahead * len(trainers.gmis) + 2
        self._metrics = run.metrics
        self._first: int | None = None

    def __call__(self, gmis: Sequence[GmiStatus]) -> bool:
        """Whether it can, with the GMIs as they are now."""
        if not all(
            one.state == "running"
            and one.iteration >= (self._unrolls if one.gmi in self._agents else 1)
            for one in gmis
        ):
            return False
        lines = read_metrics(self._metrics)
        if self._first is None:
            self._first = len(lines) + 1  # The line that has begun does not count.
        start = window_start(lines[:-1], PROFILED_ITERATIONS)
        return start is not None and start >= self._first


def window_start(lines: Sequence[Line], iterations: int) -> int | None:
    """Index of the first of the latest lines that hold what a profile goes by; None: too few.

    The line before it is needed too: the time of a line is that of its end. Something was made in
    them: where an unroll is many batches, agents can be silent for many lines.
    """
    batches = made = 0.0
    for start in range(len(lines) - 1, 0, -1):
        batches += lines[start]["async/updates"]
        made += lines[start]["async/pps"]
        if made > 0 and batches >= iterations and len(lines) - start >= FEWEST_LINES:
            return start
    return None


def measured_of(lines: Sequence[Line], num_agents: int, memory_mib: float) -> Measured:
    """Rates of one serving GMI, and of a serving and a training GPU, from a profile.

    Trainers could learn from TTOP x (update + wait for a batch) / update, agents could make PPS /
    (1 - the part of their time for which they had to wait for space). `lines` are those that
    `window_start` names, and the one before them.
    """
    before, *seen = lines
    duration_s = seen[-1]["wall_s"] - before["wall_s"]
    ends_s = [line["wall_s"] for line in lines]
    spans_s = [end - start for start, end in pairwise(ends_s)]
    batches = sum(line["async/updates"] for line in seen)
    pps = sum(s * line["async/pps"] for s, line in zip(spans_s, seen, strict=True)) / duration_s
    ttop = (seen[-1]["env_steps"] - before["env_steps"]) / duration_s
    update_s, receive_s = (
        sum(line["async/updates"] * line[f"time/{what}_s"] for line in seen) / batches
        for what in ("update", "receive")
    )
    idle = sum(line["time/wait_s"] for line in seen) / (num_agents * duration_s)
    return Measured(
        env_steps_per_s=min(pps, ttop) / num_agents,
        memory_mib=memory_mib,
        iteration_s=duration_s / batches,
        acting_per_s=pps / (1.0 - min(idle, MOST_IDLE)),
        learning_per_s=ttop * (update_s + receive_s) / update_s,
    )
