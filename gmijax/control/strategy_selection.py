"""`reduce.selection=measured`: the reduction that is fastest on this machine. No jax here.

Algorithm 1 of the paper looks at the layout alone. Here every way that the layout and the machine
allow is tried, in a job of its own that does nothing but reduce. What came of it is kept in the
user's cache folder, so that a machine pays once for a layout and a size.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from gmijax.collectives.host.shared_block import create_exchange
from gmijax.config import Timeouts
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.reduction import (
    STRATEGIES,
    needs_ring,
    select_strategy,
    why_not_intra,
    why_not_strategy,
    why_not_under,
)
from gmijax.partition.templates import TRAINER, has_role
from gmijax.runs.cache import cache_folder
from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.supervise.job_kinds import JobKind
from gmijax.supervise.run_gmis import Launch, run_gmis
from gmijax.version import versions_of

CHAIN = 8
"""Means that are taken one of the other: in training every gradient needs the mean before it."""

TIMEOUT_S = 120.0
CALLS = 40
TIMEOUTS = Timeouts(start_timeout_s=300, stall_timeout_s=120, stop_timeout_s=60, grace_s=5)

_PACKAGES = ("jax", "jaxlib", "nvidia-nccl-cu12", "nvidia-nccl-cu13", "cuda-bindings")
_TYPICAL_INPUTS, _TYPICAL_OUTPUTS = 64, 16


class Probe(NamedTuple):
    """One thing to measure."""

    strategy: str  # A reduction strategy.
    intra: str  # Exchange inside a GPU; `one_shot` has `ipc` only.
    num_floats: int  # P, length of the buffers.

    @property
    def name(self) -> str:
        """The way without the size: `mpr`, `har+ipc`."""
        return f"{self.strategy}+{self.intra}" if self.strategy == "har" else self.strategy


def with_measured(plan: Plan, machine: Machine, num_floats: int, intra: str = "auto") -> Plan:
    """The plan with the fastest strategy and exchange, and a reason that gives the times.

    Args:
      plan: made by Algorithm 1; it stays as it is unless several GMIs train, and no other.
      machine: where this is.
      num_floats: P, about; see `estimated_floats`.
      intra: the exchange that the user wants, or `auto`.

    Raises:
      GmiFailed: one of the ways does not work here.
      JobInterrupted: a signal came.
    """
    if plan.strategy == "none" or not all(has_role(roles, TRAINER) for roles in plan.roles):
        return plan
    probes = candidates(plan, num_floats, intra)
    kept = cache_folder() / "reduction" / _file_name(plan, machine, probes)
    found, source = _kept(kept, probes), f"from {kept}"
    if not found:
        rows = measure(plan, machine, probes, CALLS)
        found = {probe.name: row for probe, row in zip(probes, rows, strict=True)}
        source = "measured now"
        with suppress(OSError):  # Without a place to keep them, the next job measures again.
            kept.parent.mkdir(parents=True, exist_ok=True)
            write_json(kept, found)
    return _with_fastest(plan, probes, found, source)


def _with_fastest(
    plan: Plan, probes: Sequence[Probe], found: Mapping[str, dict[str, Any]], source: str
) -> Plan:
    """The plan with the fastest of the probes that can be used."""
    usable = [probe for probe in probes if "why_not" not in found[probe.name]]
    times_s = {probe: float(found[probe.name]["chained_s"]) for probe in usable}
    best = min(usable, key=times_s.__getitem__)
    by_paper = select_strategy(plan.layout).strategy
    shown = ", ".join(
        f"{p.name} {times_s[p] * 1e3:.3g} ms"
        if p in times_s
        else f"{p.name} not usable: {found[p.name]['why_not']}"
        for p in probes
    )
    why = (
        f"strategy {best.name}: fastest mean of {best.num_floats:,} floats here ({shown}; "
        f"{source}); Algorithm 1 says {by_paper}"
    )
    return dataclasses.replace(
        plan,
        strategy=best.strategy,
        intra=best.intra,
        reasons=(*plan.reasons, why),
        selection={
            "paper": by_paper,
            "measured": best.name,
            "num_floats": best.num_floats,
            "seconds": {probe.name: s for probe, s in times_s.items()},
        },
    )


def candidates(plan: Plan, num_floats: int, intra: str = "auto") -> list[Probe]:
    """Every way that the layout and the backend allow, once."""
    found: list[Probe] = []
    for name, strategy in STRATEGIES.items():
        # With one GMI on each GPU flat is the ring that mrr is; on one GPU har sums all slots.
        is_another = name == "flat" or (name == "one_shot" and plan.layout.num_gpus == 1)
        if is_another or why_not_strategy(name, plan.layout):
            continue
        if why_not_under(name, plan.layout, plan.backend):
            continue
        for way in strategy.ways:
            wanted = strategy.ways == ("host",) or intra in ("auto", way)
            if wanted and why_not_intra(way, plan.backend) is None:
                found.append(Probe(name, way, num_floats))
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
    # The GMIs meet for rings if one of the probes has some.
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
                    "gmijax.workers.reduction_probe",
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


def estimated_floats(*hidden: Sequence[int]) -> int:
    """About how many parameters such networks have; only a GMI knows their first and last layer.

    A power of two, so that similar networks share a measurement.
    """
    exact = 0
    for widths in hidden:
        layers = (_TYPICAL_INPUTS, *widths, _TYPICAL_OUTPUTS)
        exact += sum((low + 1) * high for low, high in pairwise(layers))
    return 1 << (exact - 1).bit_length()


def _kept(path: Path, probes: Sequence[Probe]) -> dict[str, dict[str, Any]]:
    """Earlier measurements; empty if that cannot be read, or lacks one of the probes."""
    try:
        found = read_json(path)
        for probe in probes:
            row = found[probe.name]
            if "why_not" not in row:
                float(row["chained_s"])
    except (ValueError, KeyError, TypeError, ConfigError):
        return {}
    return found


def _file_name(plan: Plan, machine: Machine, probes: Sequence[Probe]) -> str:
    """A name for all that times depend on."""
    devices = [gpu.name for gpu in machine.gpus if gpu.uuid in {s.device for s in plan.slices}]
    facts = {
        "devices": devices or [f"cpu x {len(machine.cpu_cores)}"],
        "driver": machine.driver_version,
        "versions": versions_of(_PACKAGES),
        "backend": plan.backend,
        "layout": str(plan.layout),
        "sm_percent": [share.sm_percent for share in plan.slices],
        "probes": probes,
        "format": 4,
    }
    digest = hashlib.sha256(json.dumps(facts).encode()).hexdigest()
    return f"{plan.backend}-{plan.layout.num_gpus}g-{plan.layout.num_gmis}k-{digest[:16]}.json"
