"""The template `tcg`: simulator and agent in one GMI, and an unroll is one program."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import jax

from gmijax.collection.programs import Counts, Keep, unroll
from gmijax.collection.share import Share
from gmijax.collection.tally import Tally

WARM_UP_STEPS = 10
"""Steps before the timed ones: caches, pools and clocks settle."""


def collect(share: Share) -> dict[str, Any]:
    """Makes the unrolls of this GMI; what came of it, for `result.json`.

    Raises:
      NonFiniteError: the simulation produced NaN or infinity.
      CollectiveError: another GMI is gone or stuck before all have begun.
    """
    started_s = time.monotonic()
    state = share.reset()
    arguments = share.env.model, share.policy.weights
    program = _lowered(share, share.config.unroll_length, share.keep, (*arguments, state))
    latency_s: list[float] = []
    single = None
    if share.config.latency_steps:
        single = _lowered(share, 1, Keep(steps=False, next_obs=False), (*arguments, state))
    waited_s = share.link.begin_compiling()
    program = program.compile()
    single = single and single.compile()
    compile_s = time.monotonic() - started_s - waited_s
    share.link.beat("ready", 0)
    if single is not None:
        share.meet()
        latency_s = _time_steps(share, partial(single, *arguments), state)
        # The unrolls are to begin at the starts, whatever was timed before.
        state = share.reset()
    share.meet()  # All have compiled: the clock may start.
    tally, stopped = _run(share, partial(program, *arguments), state)
    return {
        "status": "stopped" if stopped else "completed",
        "compile_s": compile_s,
        "latency_s": latency_s,
        "stages_s": {},
        **tally.outcome(),
    }


def _lowered(share: Share, length: int, keep: Keep, arguments: tuple[Any, ...]) -> Any:
    program = partial(unroll, share.env, share.policy, length, keep)
    return jax.jit(program, donate_argnums=(2,)).lower(*arguments)


def _time_steps(share: Share, step: Any, state: Any) -> list[float]:
    """Seconds of single steps of all N environments, each waited for."""
    seconds = []
    for number in range(WARM_UP_STEPS + share.config.latency_steps):
        started_s = time.perf_counter()
        state, _, _ = step(state)
        jax.block_until_ready(state)
        if number >= WARM_UP_STEPS:
            seconds.append(time.perf_counter() - started_s)
        share.link.beat("running", 0)
    return seconds


def _run(share: Share, program: Any, state: Any) -> tuple[Tally, bool]:
    tally = Tally(share.link, share.env.spec.name, share.steps_per_unroll)
    pending: tuple[Any, Counts] | None = None
    stopped = False
    try:
        for _ in range(share.num_unrolls):
            if stopped := share.link.stop_requested:
                break
            state, *made = program(state)
            # The counts of the unroll before are fetched while this one runs.
            _keep(share, tally, pending)
            pending = made[0], made[1]
        _keep(share, tally, pending)
        if share.writer is not None:
            share.writer.wait()
    finally:
        tally.close()
    return tally, stopped


def _keep(share: Share, tally: Tally, unrolled: tuple[Any, Counts] | None) -> None:
    """Counts an unroll and writes it; in this order, so that none with bad numbers is kept."""
    if unrolled is None:
        return
    steps, counts = unrolled
    tally.add(counts)
    if share.writer is not None:
        share.writer.write(steps)
