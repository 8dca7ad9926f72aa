"""Jobs of GMIs that do nothing but reduce, for `benchmarks.reduction`. No jax here."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gmijax.collectives.host.shared_block import create_exchange
from gmijax.config import Timeouts
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.reduction import (
    STRATEGIES,
    needs_ring,
    why_not_intra,
    why_not_strategy,
    why_not_under,
)
from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.supervise.job_kinds import JobKind
from gmijax.supervise.run_gmis import Launch, run_gmis

CHAIN = 8
"""Means that are taken one of the other: in training every gradient needs the mean before it."""

TIMEOUT_S = 120.0
TIMEOUTS = Timeouts(start_timeout_s=300, stall_timeout_s=120, stop_timeout_s=60, grace_s=5)


class Probe(NamedTuple):
    """One thing to measure."""

    strategy: str  # A reduction strategy.
    intra: str  # Exchange inside a GPU; `one_shot` has `ipc` only.
    num_floats: int  # P, length of the buffers.

    @property
    def name(self) -> str:
        """The way without the size: `mpr`, `har+ipc`."""
        return f"{self.strategy}+{self.intra}" if self.strategy == "har" else self.strategy


def candidates(plan: Plan, num_floats: int) -> list[Probe]:
    """Every way that the layout and the backend allow, once."""
    found: list[Probe] = []
    for name, strategy in STRATEGIES.items():
        # With one GMI on each GPU flat is the ring that mrr is; on one GPU har sums all slots.
        is_another = name == "flat" or (name == "one_shot" and plan.layout.num_gpus == 1)
        if is_another or why_not_strategy(name, plan.layout):
            continue
        if why_not_under(name, plan.layout, plan.backend):
            continue
        ways = [way for way in strategy.ways if why_not_intra(way, plan.backend) is None]
        found += [Probe(name, way, num_floats) for way in ways]
    return found


def measure(
    plan: Plan, machine: Machine, probes: Sequence[Probe], calls: int
) -> list[dict[str, Any]]:
    """Runs one job of GMIs that do nothing but reduce; for every probe its slowest GMI's times.

    Returns:
      A row a probe: `median_s`, `p10_s`, `p90_s` of one mean alone, `chained_s` of one of
      `CHAIN` that need each other, all in seconds, and the `device`. Where an exchange turns out
      not to work here: `why_not` in place of times.

    Raises:
      GmiFailed: a probe does not work here.
      JobInterrupted: a signal came.
    """
    # The GMIs connect for rings if one of the probes needs one.
    rings = any(needs_ring(probe.strategy, plan.layout) for probe in probes)
    plan = dataclasses.replace(plan, strategy="har" if rings else "mpr", intra="host")
    numbers = range(len(probes))
    with tempfile.TemporaryDirectory(prefix="gmijax-") as scratch:
        run = RunPaths(Path(scratch))
        write_json(run.plan, plan.to_dict())
        write_json(run.config, {"probes": [p._asdict() for p in probes], "calls": calls})
        run_gmis(
            Launch(
                plan=plan,
                machine=machine,
                run=run,
                kind=JobKind(
                    "benchmarks.reduction_probe",
                    shared=lambda _: {block_variable(k): create_exchange for k in numbers},
                ),
                timeouts=TIMEOUTS,
            )
        )
        found = [read_json(run.gmi(gmi).result) for gmi in plan.layout.gmis]
    by_probe = zip(*(result["rows"] for result in found), strict=True)
    slowest = [max(rows, key=lambda row: row.get("chained_s", 0)) for rows in by_probe]
    return [{**row, "device": found[0]["device"]} for row in slowest]


def block_variable(number: int) -> str:
    """Environment variable that names the shared block of a probe."""
    return f"GMIJAX_PROBE_FD_{number}"
