"""Main of a GMI that does nothing but reduce: `python -m benchmarks.reduction_probe`.

One process measures all strategies and sizes one after the other, because starting is most of
what a measurement costs. `benchmarks.reduction_jobs` starts it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.reduction_jobs import CHAIN, TIMEOUT_S, block_variable
from gmijax.collectives.communicator import CommunicatorConfig, make_communicator
from gmijax.collectives.interface import Collectives, Communicator
from gmijax.errors import DeviceMemoryUnavailable
from gmijax.partition.plan import Plan
from gmijax.runs.folder import read_json
from gmijax.supervise.child import ChildLink, required_fd, run_gmi

if TYPE_CHECKING:
    import jax

WARM_UP_CALLS = 10
STEPS = 4
"""Whole steps between two waits for the device; training waits after dozens."""


def _measure(link: ChildLink) -> dict[str, Any]:
    plan, task = Plan.from_dict(read_json(link.run.plan)), read_json(link.run.config)
    link.beat("ready", 0)
    rows: list[dict[str, Any]] = []
    for number, probe in enumerate(task["probes"]):
        try:
            comm = _communicator(plan, link.gmi, number, probe)
        except DeviceMemoryUnavailable as error:  # On all ranks alike, so all go on.
            rows.append({"why_not": str(error)})
        else:
            rows.append(_times(comm, probe["num_floats"], task["calls"]))
            comm.close()
        link.beat("running", number)
    import jax

    return {"rows": rows, "device": jax.local_devices()[0].device_kind}


def _communicator(plan: Plan, gmi: int, number: int, probe: Mapping[str, Any]) -> Communicator:
    """The communicator of one probe, with a shared block of its own."""
    return make_communicator(
        probe["strategy"],
        CommunicatorConfig(
            layout=plan.layout,
            rank=gmi,
            num_floats=probe["num_floats"],
            exchange_fd=required_fd(block_variable(number)),
            timeout_s=TIMEOUT_S,
            rendezvous_timeout_s=TIMEOUT_S,
            intra=probe["intra"],
        ),
    )


def _times(comm: Communicator, num_floats: int, calls: int) -> dict[str, float]:
    """Seconds of a mean alone, and of one of many that need each other, as in training."""
    alone, chain = _means(comm, num_floats, 1, 1), _means(comm, num_floats, CHAIN, STEPS)
    for _ in range(WARM_UP_CALLS):
        alone()
        chain()
    alone_s = [_timed(alone) for _ in range(calls)]
    chained_s = [_timed(chain) / (CHAIN * STEPS) for _ in range(-(-calls // CHAIN))]
    low, middle, high = np.quantile(alone_s, (0.1, 0.5, 0.9)).tolist()
    chained = float(np.median(chained_s))
    return {"median_s": middle, "p10_s": low, "p90_s": high, "chained_s": chained}


def _means(comm: Communicator, num_floats: int, length: int, steps: int) -> Callable[[], None]:
    """`steps` steps of `length` means each, queued as whole steps of training are."""
    import jax
    import jax.numpy as jnp

    def step(
        collectives: Collectives, _: Any, buffer: jax.Array, own: Any
    ) -> tuple[jax.Array, Any, Any]:
        return jax.lax.fori_loop(0, length, lambda _, b: collectives.mean(b), buffer), own, ()

    program = comm.program(step)
    carried = [(jnp.ones(num_floats), ())]
    program.trace((), *carried[0])
    program.compile()

    def call() -> None:
        for _ in range(steps):
            carried[0] = program(*carried[0])[:2]
        program.wait()

    return call


def _timed(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


if __name__ == "__main__":
    sys.exit(run_gmi(_measure))
