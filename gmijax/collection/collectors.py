"""What a serving GMI does: simulator and agent in one, an unroll is one program (`tcg`).

The template `tdg` keeps them apart: `gmijax.baselines.tdg`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax

from gmijax.collection.programs import ActingPolicy, CollectedStep, RecordSpec, unroll
from gmijax.collection.recording import CollectionStats, ShardWriter
from gmijax.compile_once import compile_once
from gmijax.config import ServeConfig
from gmijax.learning.start import begin_episodes
from gmijax.learning.unroll import Counts
from gmijax.partition.plan import Plan
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.supervise.child import ChildLink

WARM_UP_STEPS = 10
"""Steps before the timed ones: caches, pools and clocks settle."""


class CollectorContext(NamedTuple):
    """One GMI's part of a serving job.

    Attributes:
      rank: among the GMIs that simulate (an agent: among the agents).
      first_unroll: unrolls that earlier jobs have written of this GMI's part.
      num_unrolls: unrolls that are left to be made.
      writer: takes the experience, None where it is not kept.
    """

    config: ServeConfig
    link: ChildLink
    env: BatchedEnv
    policy: ActingPolicy
    rank: int
    first_unroll: int
    num_unrolls: int
    writer: ShardWriter | None
    barrier: Callable[[], Any]

    @property
    def keep(self) -> RecordSpec:
        """What of every step leaves the compiled program."""
        return RecordSpec(self.writer is not None, self.config.output.next_obs)

    def reset(self) -> BatchState:
        """Environments at their starts.

        Starts depend on the seed, on the number of the environment in the whole job, and on how
        many unrolls were there before: a continued job makes other episodes, not the same.
        """
        key = jax.random.fold_in(jax.random.key(self.config.seed), self.first_unroll)
        num_envs = self.config.envs_per_gmi
        kept_steps = self.config.unroll_length if self.keep.steps else 0
        first_env = self.rank * num_envs
        return begin_episodes(self.env, key, first_env, num_envs, kept_steps=kept_steps)

    def record(self, unrolls: Iterable[tuple[CollectedStep | None, Counts]]) -> dict[str, Any]:
        """Takes unrolls until there are no more; returns the outcome for `result.json`."""
        steps_per_unroll = self.config.envs_per_gmi * self.config.unroll_length
        stats = CollectionStats(self.link, self.env.spec.name, steps_per_unroll)
        try:
            for steps, counts in unrolls:
                stats.add(counts)  # First, so that no unroll with bad numbers is kept.
                if self.writer is not None and steps is not None:
                    self.writer.write(steps)
            if self.writer is not None:
                self.writer.wait()
        finally:
            stats.close()
        is_complete = stats.num_unrolls == self.num_unrolls
        return {"status": "completed" if is_complete else "stopped", **stats.outcome()}


def collect(context: CollectorContext, plan: Plan) -> dict[str, Any]:
    """Makes the unrolls of a GMI of the plan; the outcome for `result.json`.

    Raises:
      NonFiniteError: too many environments gave numbers that are not finite or beyond all bounds.
      CollectiveError: another GMI is gone or stuck before all have begun.
    """
    del plan
    started_s = time.monotonic()
    state = context.reset()
    arguments = context.env.model, context.policy.weights
    program = _lowered(context, context.config.unroll_length, context.keep, (*arguments, state))
    latency_s: list[float] = []
    single = None
    if context.config.latency_steps:
        single = _lowered(context, 1, RecordSpec(steps=False, next_obs=False), (*arguments, state))
    context.link.begin_compiling()
    program = compile_once(program)
    single = single and compile_once(single)
    compile_s = time.monotonic() - started_s - context.link.start_s["waiting"]
    context.link.beat("ready", 0)
    if single is not None:
        context.barrier()
        latency_s = _time_steps(context, partial(single, *arguments), state)
        # The unrolls are to begin at the starts, whatever was timed before.
        state = context.reset()
    context.barrier()  # All have compiled: the clock may start.
    outcome = context.record(_unrolls(context, partial(program, *arguments), state))
    return {"compile_s": compile_s, "latency_s": latency_s, "stages_s": {}, **outcome}


def _lowered(
    context: CollectorContext, length: int, keep: RecordSpec, arguments: tuple[Any, ...]
) -> Any:
    program = partial(unroll, context.env, context.policy, length, keep)
    return jax.jit(program, donate_argnums=(2,)).lower(*arguments)


def _time_steps(context: CollectorContext, step: Any, state: Any) -> list[float]:
    """Seconds of single steps of all N environments, each waited for."""
    seconds = []
    for number in range(WARM_UP_STEPS + context.config.latency_steps):
        started_s = time.perf_counter()
        state, _, _ = step(state)
        jax.block_until_ready(state)
        if number >= WARM_UP_STEPS:
            seconds.append(time.perf_counter() - started_s)
        context.link.beat("running", 0)
    return seconds


def _unrolls(
    context: CollectorContext, program: Any, state: Any
) -> Iterator[tuple[CollectedStep | None, Counts]]:
    """Gives out each unroll while the next one is computed."""
    before = None
    for _ in range(context.num_unrolls):
        if context.link.stop_requested:
            break
        state, *made = program(state)
        if before is not None:
            yield before
        before = made[0], made[1]
    if before is not None:
        yield before
