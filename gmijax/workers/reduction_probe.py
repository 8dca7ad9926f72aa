"""Main of a GMI that does nothing but reduce: `python -m gmijax.workers.reduction_probe`.

One process measures all strategies and sizes one after the other, because starting is most of
what a measurement costs. `gmijax.control.selection` starts it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gmijax.collectives.build import Membership, build_reducer, join_world
from gmijax.collectives.interface import (
    DeviceMean,
    DeviceReducer,
    Peers,
    Reducer,
    stays_on_device,
)
from gmijax.control.selection import CHAIN, TIMEOUT_S, block_variable
from gmijax.errors import DeviceMemoryUnavailable
from gmijax.partition.plan import Plan
from gmijax.runs.folder import read_json
from gmijax.supervise.child import ChildLink, required_fd, run_gmi

if TYPE_CHECKING:
    import jax

    from gmijax.collectives.ring import World

WARM_UP_CALLS = 10
STEPS = 4
"""Whole steps between two waits for the device; training waits after dozens."""


def main() -> int:
    """Measures and writes `result.json`; returns 0."""
    return run_gmi(_measure)


def _measure(link: ChildLink) -> dict[str, Any]:
    plan, task = Plan.from_dict(read_json(link.run.plan)), read_json(link.run.config)
    world = join_world(plan.strategy, plan.layout, link.gmi, link.rendezvous, TIMEOUT_S)
    if world is not None:
        world.is_kept = True
    link.beat("ready", 0)
    rows: list[dict[str, Any]] = []
    for number, probe in enumerate(task["probes"]):
        try:
            reducer = _reducer(plan, link.gmi, world, number, probe)
        except DeviceMemoryUnavailable as error:  # On all ranks alike, so all go on.
            rows.append({"why_not": str(error)})
        else:
            rows.append(_times(reducer, probe["num_floats"], task["calls"]))
            reducer.close()
        link.beat("running", number)
    if world is not None:
        world.leave()
    import jax

    return {"rows": rows, "device": jax.local_devices()[0].device_kind}


def _reducer(
    plan: Plan, gmi: int, world: World | None, number: int, probe: Mapping[str, Any]
) -> Reducer:
    """The reducer of one probe, with a shared block of its own."""
    return build_reducer(
        probe["strategy"],
        Membership(
            layout=plan.layout,
            rank=gmi,
            num_floats=probe["num_floats"],
            exchange_fd=required_fd(block_variable(number)),
            timeout_s=TIMEOUT_S,
            rendezvous_timeout_s=TIMEOUT_S,
            world=world,
            intra=probe["intra"],
        ),
    )


def _times(reducer: Reducer, num_floats: int, calls: int) -> dict[str, float]:
    """Seconds of a mean alone, and of one of many that need each other, as in training."""
    if stays_on_device(reducer):
        alone, chain, length = _on_device(reducer, num_floats)
    else:
        alone, chain, length = _through_host(reducer, num_floats)
    for _ in range(WARM_UP_CALLS):
        alone()
        chain()
    alone_s = [_timed(alone) for _ in range(calls)]
    chained_s = [_timed(chain) / length for _ in range(-(-calls // CHAIN))]
    low, middle, high = np.quantile(alone_s, (0.1, 0.5, 0.9)).tolist()
    chained = float(np.median(chained_s))
    return {"median_s": middle, "p10_s": low, "p90_s": high, "chained_s": chained}


class _Ways(NamedTuple):
    """How to take means, from a gradient on the device to the mean on the device.

    Attributes:
      alone: takes one.
      chain: takes several, each of the one before.
      length: of the chain.
    """

    alone: Callable[[], Any]
    chain: Callable[[], Any]
    length: int = CHAIN


def _on_device(reducer: DeviceReducer, num_floats: int) -> _Ways:
    import jax

    gradient = jax.device_put(np.ones(num_floats, np.float32))

    def means(times: int) -> jax.Array:
        def chain(mean: DeviceMean) -> jax.Array:
            buffer = gradient
            for _ in range(times):
                buffer = mean(buffer)
            return buffer

        return reducer.run_on_device(chain)

    whole = _whole_steps(reducer, gradient)
    if whole is not None:
        return _Ways(lambda: means(1), whole, CHAIN * STEPS)
    return _Ways(lambda: means(1), lambda: means(CHAIN))


def _through_host(reducer: Reducer, num_floats: int) -> _Ways:
    import jax

    from gmijax.learning.updates import gradient_sharding

    gradient = jax.device_put(np.ones(num_floats, np.float32))
    fetch = jax.jit(lambda x: x + 0.0, out_shardings=gradient_sharding(reducer))

    def means(times: int) -> jax.Array:
        buffer = gradient
        for _ in range(times):
            mean = reducer.mean(np.asarray(fetch(buffer)))
            buffer = jax.device_put(np.array(mean))
        return buffer.block_until_ready()

    return _Ways(lambda: means(1), lambda: means(CHAIN))


def _whole_steps(reducer: DeviceReducer, gradient: jax.Array) -> Callable[[], None] | None:
    """`STEPS` steps of `CHAIN` means each, queued as where whole steps of training are.

    None where they are not.
    """
    import jax

    def step(peers: Peers, _: Any, buffer: jax.Array, own: Any) -> tuple[jax.Array, Any, Any]:
        return jax.lax.fori_loop(0, CHAIN, lambda _, b: peers.mean(b), buffer), own, ()

    program = reducer.spmd(step)
    if program is None:
        return None
    program.trace((), gradient, ())
    program.compile()
    # A copy, because the program takes the memory of what it is given; from then on its own.
    carried = [(gradient.copy(), ())]

    def call() -> None:
        for _ in range(STEPS):
            carried[0] = program(*carried[0])[:2]
        program.wait()

    return call


def _timed(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


if __name__ == "__main__":
    sys.exit(main())
