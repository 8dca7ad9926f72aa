"""Plans without a training configuration."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, TypeAlias

from gmijax.config import BackendName, PlanConfig, ReduceConfig
from gmijax.partition.machine import detect_machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.schema import from_dict

BackendChoice: TypeAlias = Literal["auto", BackendName]


def plan(
    gpus: int | Sequence[int] = 1,
    gmis_per_gpu: int = 1,
    *,
    layout: Sequence[Sequence[int]] | None = None,
    backend: BackendChoice = "auto",
    sm_percent: float | Sequence[float] | None = None,
    memory_fraction: float | Sequence[float] | None = None,
    strategy: Literal["auto", "mpr", "mrr", "har", "flat", "one_shot"] = "mpr",
) -> Plan:
    """A plan for roles of one's own on this machine; see `gmijax.launch`.

    Args:
      gpus: number of GPUs, or their indices as nvidia-smi lists them. Without a GPU here they
        are virtual: groups of processes.
      gmis_per_gpu: GMIs on each of them.
      layout: ids of the GMIs of every GPU, e.g. `[[0, 1], [2]]`, in place of the two.
      backend: how a GMI gets its share; `auto` decides, `Plan.reasons` says why.
      sm_percent: cap on the SMs of every GMI in percent (mps), or one for each; None for no cap.
      memory_fraction: part of a GPU's memory for every GMI, or one for each; None: 0.8 split
        evenly.
      strategy: how the mean of many float32 over all GMIs is taken (docs/reduction.md); `auto`
        by the layout. A role's data pass through host memory, so `mpr` has the least to do.

    Raises:
      ConfigError: bad input, or this machine cannot do it.
    """
    given = {
        "gpus": gpus,
        "gmis_per_gpu": gmis_per_gpu,
        "layout": layout,
        "backend": backend,
        "sm_percent": sm_percent,
        "memory_fraction": memory_fraction,
    }
    # As from a command line: what is no number, or not among the allowed, is told in one line.
    wanted = from_dict(PlanConfig, {key: _plain(value) for key, value in given.items()}, "plan.")
    intra = "auto" if strategy == "one_shot" else "host"
    reduce = ReduceConfig(strategy=strategy, intra=intra, timeout_s=1.0)
    made = make_plan(wanted, reduce, 0, detect_machine())
    # What the templates call roles are parts of reinforcement learning.
    reasons = tuple(reason for reason in made.reasons if not reason.startswith("template "))
    return dataclasses.replace(made, roles=(), reasons=reasons)


def _plain(value: Any) -> Any:
    """Sequences of any kind as lists."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value
