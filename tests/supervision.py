"""Builds jobs of fake GMIs for the tests of the supervisor and of the backends."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gmijax import errors
from gmijax.config import PlanConfig, ReduceConfig
from gmijax.machine.nvidia import Gpu
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends import Backend, open_backend
from gmijax.supervise.environment import gmi_environment
from gmijax.supervise.supervisor import Job, Timeouts

CHECKOUT = Path(errors.__file__).parents[1]
TESTS = Path(__file__).parent


plan_config = PlanConfig
reduce_config = ReduceConfig


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


def make_job(
    run: RunPaths,
    modes: Sequence[str],
    backend: Backend,
    plan: Plan,
    *,
    command: Callable[[int], list[str]] | None = None,
    compile_once: bool = True,
    inherited_fds: Mapping[str, int] | None = None,
    **timeouts_s: float,
) -> Job:
    """A job whose GMI i runs `fake_gmi.py modes[i]`."""

    def environment(gmi: int) -> Mapping[str, str]:
        inherited = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
        return gmi_environment(plan, gmi, inherited, run.root, backend.environment(gmi))

    limits = {"start": 20.0, "stall": 20.0, "stop": 20.0, "grace": 2.0} | timeouts_s
    return Job(
        run=run,
        gmis=range(len(modes)),
        command=command or (lambda gmi: [sys.executable, str(TESTS / "fake_gmi.py"), modes[gmi]]),
        environment=environment,
        backend=backend,
        timeouts=Timeouts(
            start_timeout_s=limits["start"],
            stall_timeout_s=limits["stall"],
            stop_timeout_s=limits["stop"],
            grace_s=limits["grace"],
        ),
        inherited_fds=inherited_fds or {},
        compile_once=compile_once,
    )


def cpu_job(run: RunPaths, modes: Sequence[str], **changes: Any) -> Job:
    """A job on the cpu backend."""
    here = machine(0)
    plan = make_plan(plan_config(gmis_per_gpu=len(modes)), reduce_config(), 8, here)
    return make_job(run, modes, open_backend(plan, here, run), plan, **changes)
