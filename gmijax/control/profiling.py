"""One profile of a search: a real short job in child GMIs. No jax here.

`corun` runs all GMIs of a GPU at once; `isolated` runs one of them alone, with the share that it
would have among the others. Whatever goes wrong in the job is an answer, not an error.
"""

from __future__ import annotations

import dataclasses
import platform
import shutil
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

from gmijax.config import PlanConfig
from gmijax.control.launcher import Launch, run_gmis
from gmijax.control.workload import Workload
from gmijax.errors import ConfigError, GmijaxError, JobInterrupted
from gmijax.partition.gmi_process import GmiStatus
from gmijax.partition.layout import Layout
from gmijax.partition.machine import Machine
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.partition.points import Measured, NotRunnable, Point
from gmijax.partition.supervisor import Patience
from gmijax.rundir import RunPaths, write_json
from gmijax.schema import to_dict
from gmijax.version import __version__, versions_of

Mode = Literal["corun", "isolated"]

_GRACE_S = 3.0
_VERSIONS = ("jax", "jaxlib", "mujoco-mjx", "warp-lang")


class ProfileLate(Exception):
    """A profile did not end within its time limit; says how far its GMIs were."""


def profile(
    workload: Workload,
    point: Point,
    mode: Mode,
    machine: Machine,
    run: RunPaths,
    *,
    limit_s: float,
    on_tick: Callable[[Sequence[GmiStatus]], None],
    on_warning: Callable[[str], None],
) -> Measured | NotRunnable:
    """Runs a short job at a point; `run` is its folder, of which logs are kept.

    Raises:
      ProfileLate: it did not end within `limit_s`.
      JobInterrupted: a signal came.
    """
    try:
        plan = plan_at(workload, point, mode, machine)
        config = workload.config_at(point, plan.layout.num_gmis)
    except ConfigError as error:
        return NotRunnable(str(error))
    write_json(run.config, to_dict(config))
    write_json(run.plan, plan.to_dict())
    deadline_s = time.monotonic() + limit_s

    def watch(gmis: tuple[GmiStatus, ...]) -> None:
        on_tick(gmis)
        if time.monotonic() > deadline_s:
            states = ", ".join(f"GMI {gmi.gmi} {gmi.state}" for gmi in gmis)
            raise ProfileLate(f"no end within {limit_s:.0f} s ({states})")

    launch = Launch(
        plan=plan,
        machine=machine,
        run=run,
        kind=workload.kind,
        patience=_patience(limit_s),
        on_warning=on_warning,
        is_enough=workload.is_enough and workload.is_enough(plan, run),
    )
    try:
        run_gmis(launch, watch)
        return _read(workload, plan, run)
    except JobInterrupted:
        raise
    except GmijaxError as error:
        return NotRunnable(" ".join(str(error).split()))
    finally:
        shutil.rmtree(run.checkpoints, ignore_errors=True)


def _patience(limit_s: float) -> Patience:
    # The supervisor's own limits are for jobs of unknown length.
    return Patience(
        start_timeout_s=2 * limit_s,
        stall_timeout_s=2 * limit_s,
        stop_timeout_s=_GRACE_S,
        grace_s=_GRACE_S,
    )


def plan_at(workload: Workload, point: Point, mode: Mode, machine: Machine) -> Plan:
    """The plan of a profile, on the first GPU of the job, or as the workload has it.

    `isolated` is the first GMI of the plan that `corun` has, with its memory and cores; where the
    backend can cap SMs, with an even part of them.

    Raises:
      ConfigError: a point that the machine or the backend does not allow.
    """
    if workload.plan_of is not None:
        return workload.plan_of(point, machine)
    gpus = workload.plan.gpus
    one_gpu = dataclasses.replace(
        workload.plan,
        gpus=1 if isinstance(gpus, int) else gpus[:1],
        gmis_per_gpu=point.gmis_per_gpu,
        layout=None,
    )

    def planned(config: PlanConfig) -> Plan:
        return make_plan(
            config, workload.reduce, point.num_envs, machine, template=workload.template
        )

    plan = planned(one_gpu)
    if mode == "corun" or point.gmis_per_gpu == 1:
        return plan
    if plan.backend == "mps" and one_gpu.sm_percent is None:
        plan = planned(dataclasses.replace(one_gpu, sm_percent="even"))
    return dataclasses.replace(
        plan,
        layout=Layout(((0,),)),
        slices=plan.slices[:1],
        roles=plan.roles[:1],
        strategy="none",
    )


def platform_of(workload: Workload, machine: Machine) -> Literal["cpu", "gpu"]:
    """What the GMIs of a job will run on."""
    return "gpu" if machine.gpus and workload.plan.backend != "cpu" else "cpu"


def device_of(workload: Workload, machine: Machine) -> str:
    """What is profiled: the model of the job's first GPU, or the CPU's architecture and cores."""
    if platform_of(workload, machine) == "cpu":
        return f"{platform.machine()} CPU, {len(machine.cpu_cores)} cores"
    gpus = workload.plan.gpus
    wanted = None if isinstance(gpus, int) else gpus[0]
    chosen = next((gpu for gpu in machine.gpus if gpu.index == wanted), machine.gpus[0])
    return f"{chosen.name}, {chosen.memory_mib} MiB"


def store_key(workload: Workload, machine: Machine) -> dict[str, Any]:
    """Everything but the point that decides what a profile says; see `ProfileStore`."""
    plan = {
        name: value
        for name, value in to_dict(workload.plan).items()
        if name not in ("gpus", "gmis_per_gpu", "layout")
    }
    reduce = to_dict(workload.reduce)
    del reduce["timeout_s"]
    return {
        "device": device_of(workload, machine),
        "task": workload.env.slug,
        "env": to_dict(workload.env),
        "plan": plan,
        "reduce": reduce,
        "mps": machine.mps_control is not None,
        "driver": machine.driver_version,
        "versions": installed_versions(),
        **workload.key,
    }


def installed_versions() -> dict[str, str | None]:
    """Versions of what computes, None for what is not installed."""
    return {"gmijax": __version__, **versions_of(_VERSIONS)}


def _read(workload: Workload, plan: Plan, run: RunPaths) -> Measured | NotRunnable:
    try:
        return workload.read(plan, run)
    # All GMIs ended well, and still their results do not say what they should.
    except (OSError, ArithmeticError, LookupError, TypeError, ValueError) as error:
        return NotRunnable(f"no result to read: {type(error).__name__}: {error}")
