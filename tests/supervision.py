"""Builds jobs of fake GMIs for the tests of the supervisor and of the backends."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gmijax import errors
from gmijax.config import PlanConfig, ReduceConfig, Timeouts
from gmijax.machine.nvidia import Gpu
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import META, RunPaths, write_json
from gmijax.supervise.backends import open_backend
from gmijax.supervise.job_kinds import JobKind
from gmijax.supervise.start_gmi import Launch
from gmijax.supervise.stop_signals import StopSignals
from gmijax.supervise.supervisor import Supervisor

CHECKOUT = Path(errors.__file__).parents[1]
TESTS = Path(__file__).parent


MPS = Path("/usr/bin/nvidia-cuda-mps-control")
"""For faked machines: a control program of MPS that nothing starts."""


def gpu(index: int, *, mig_enabled: bool = False) -> Gpu:
    """A GPU of a faked machine."""
    return Gpu(index, f"GPU-{index}{index}-uuid", "H200", 143771, (9, 0), mig_enabled)


def machine(num_gpus: int, **changes: Any) -> Machine:
    """A faked machine with four CPU cores of this one, or fewer."""
    values: dict[str, Any] = {
        "gpus": tuple(gpu(index) for index in range(num_gpus)),
        "cpu_cores": tuple(sorted(os.sched_getaffinity(0)))[:4],
        "driver_version": "580.159.03" if num_gpus else None,
    }
    return Machine(**{**values, **changes})


def planned(
    here: Machine,
    reduce: Mapping[str, Any] | None = None,
    nodes: Mapping[str, Machine] | None = None,
    **plan: Any,
) -> Plan:
    """The plan of a synchronous training with these keys of `reduce` and `plan`; N is 64."""
    return make_plan(PlanConfig(**plan), ReduceConfig(**(reduce or {})), 64, here, nodes=nodes)


def gpus_of_nodes(*num_gpus: int, **changes: Any) -> dict[str, Machine]:
    """Nodes whose GPUs are all different, with MPS."""
    nodes: dict[str, Machine] = {}
    for place, count in enumerate(num_gpus):
        gpus = tuple(
            gpu(index)._replace(uuid=f"GPU-{place}-{index}", **changes) for index in range(count)
        )
        nodes[f"10.0.0.{place}"] = machine(count, gpus=gpus, mps_control=Path("/mps"))
    return nodes


def plan_on(nodes: dict[str, Machine], **settings: Any) -> Plan:
    first = next(iter(nodes.values()))
    return make_plan(PlanConfig(**settings), ReduceConfig(), 16, first, nodes=nodes)


def save(run: RunPaths, env_steps: int) -> Path:
    """A checkpoint of `ant` that holds nothing but its meta data."""
    meta = CheckpointMeta("ant", "ppo", env_steps, 1, 8, ((8,), (8, 4)), "jax")
    return save_meta(run, meta)


def save_meta(run: RunPaths, meta: CheckpointMeta) -> Path:
    """A checkpoint of nothing else."""
    run.checkpoint(meta.env_steps).mkdir(parents=True, exist_ok=True)
    write_json(run.checkpoint(meta.env_steps) / META, meta.to_dict())
    return run.checkpoint(meta.env_steps)


def make_launch(run: RunPaths, modes: Sequence[str], plan: Plan, **limits: float) -> Launch:
    """A job whose GMI i runs `fake_gmi` with `modes[i]`."""
    limits_s = {"start": 90.0, "stall": 90.0, "stop": 90.0, "grace": 2.0} | limits
    return Launch(
        plan=plan,
        machine=machine(0),
        run=run,
        kind=JobKind("fake_gmi"),
        timeouts=Timeouts(
            start_timeout_s=limits_s["start"],
            stall_timeout_s=limits_s["stall"],
            stop_timeout_s=limits_s["stop"],
            grace_s=limits_s["grace"],
        ),
        variables={
            "PYTHONPATH": f"{CHECKOUT}{os.pathsep}{TESTS}",
            "FAKE_GMI_MODES": ",".join(modes),
        },
    )


def cpu_supervisor(
    run: RunPaths,
    modes: Sequence[str],
    inherited_fds: Mapping[str, int] | None = None,
    signals: StopSignals | None = None,
    waits: bool = False,
    **changes: Any,
) -> Supervisor:
    """Of a job on the cpu backend; `waits`: after Ctrl-C, as training does."""
    here = machine(0)
    plan = planned(here, gmis_per_gpu=len(modes))
    backend = open_backend(plan, here, run)
    launch = replace(make_launch(run, modes, plan, **changes), waits_after_ctrl_c=waits)
    return Supervisor(launch, backend, inherited_fds, signals=signals)
