"""One GMI of `benchmarks.reduction`: reduces the same buffer again and again."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from gmijax.collectives.build import Membership, build_reducer, join_world
from gmijax.collectives.interface import Reducer, stays_on_device
from gmijax.partition.child import ChildLink, run_gmi
from gmijax.partition.plan import Plan
from gmijax.rundir import read_json

WARM_UP_CALLS = 20
TIMEOUT_S = 60.0


def main() -> int:
    """Measures and writes `result.json`; returns 0."""
    return run_gmi(_measure)


def _measure(link: ChildLink) -> dict[str, Any]:
    plan, task = Plan.from_dict(read_json(link.run.plan)), read_json(link.run.config)
    world = join_world(plan.strategy, plan.layout, link.gmi, link.rendezvous, TIMEOUT_S)
    reducer = build_reducer(
        plan.strategy,
        Membership(
            layout=plan.layout,
            rank=link.gmi,
            num_floats=task["num_floats"],
            exchange_fd=link.exchange_fd,
            timeout_s=TIMEOUT_S,
            rendezvous_timeout_s=TIMEOUT_S,
            world=world,
        ),
    )
    link.beat("ready", 0)
    call, device = _exchange(reducer, task["num_floats"])
    times_s = np.array([_timed(call) for _ in range(WARM_UP_CALLS + task["calls"])])
    reducer.close()
    low, middle, high = np.quantile(times_s[WARM_UP_CALLS:], (0.1, 0.5, 0.9)).tolist()
    return {"median_s": middle, "p10_s": low, "p90_s": high, "device": device}


def _exchange(reducer: Reducer, num_floats: int) -> tuple[Callable[[], Any], str]:
    """From a gradient on the device to its mean on the device, as training does it."""
    import jax

    from gmijax.ppo.programs import gradient_sharding

    device = jax.local_devices()[0]
    gradient = jax.device_put(np.ones(num_floats, np.float32))
    if stays_on_device(reducer):
        return lambda: reducer.mean_on_device(gradient).block_until_ready(), device.device_kind
    fetch = jax.jit(lambda x: x + 0.0, out_shardings=gradient_sharding(reducer))

    def through_host() -> jax.Array:
        mean = reducer.mean(np.asarray(fetch(gradient)))
        return jax.device_put(np.array(mean)).block_until_ready()

    return through_host, device.device_kind


def _timed(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


if __name__ == "__main__":
    sys.exit(main())
