"""State of this machine for `gmijax.doctor`. No jax here: a child asks it."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple

from gmijax.config import PlanConfig, ReduceConfig
from gmijax.control.features import EXTRAS, OpenGl, find_opengl_here
from gmijax.errors import GmijaxError
from gmijax.machine.interpreter import command
from gmijax.machine.jax_settings import without_breaking
from gmijax.machine.nvidia import Gpu, nvml_problem
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.partition.planner import make_plan
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends.mps import MpsBackend
from gmijax.version import pinned_version, versions_of

PROBE_TIMEOUT_S: Final = 120.0

REQUIRED: Final = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint")
_OPTIONAL: Final = (
    *("jax-cuda12-plugin", "jax-cuda13-plugin", "nvidia-nccl-cu12", "nvidia-nccl-cu13"),
    *("cuda-bindings", "cuda-core", "nvidia-ml-py", "warp-lang", "brax", "playground"),
)
_CUDA_VARIABLES: Final = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")


class JaxView(NamedTuple):
    """Devices that jax sees in a process that is started as a GMI would be."""

    platform: str | None  # `cpu` or `gpu`; None where jax failed.
    devices: tuple[str, ...] = ()  # The kind of every device.
    error: str | None = None  # Why it failed, in one line.


class SystemInfo(NamedTuple):
    """State of this machine."""

    machine: Machine  # GPUs, driver, MPS.
    jax: JaxView  # What jax sees.
    versions: Mapping[str, str | None]  # Of packages, None for one that is not installed.
    variables: Mapping[str, str] = MappingProxyType({})  # The environment.
    # Why NVML fails although it is installed, None where it does not.
    nvml_error: str | None = None
    # Why an MPS daemon cannot be started, None where it can or was not tried.
    mps_error: str | None = None
    # The one warp-lang that mujoco-mjx was made for, None where it names none.
    wanted_warp: str | None = None
    opengl: OpenGl | None = None  # What draws films; None: not tried.


def inspect_system() -> SystemInfo:
    """Looks at this machine: asks NVML, jax and OpenGL (in children), tries to start MPS."""
    machine = detect_machine()
    extras = [package for extra in EXTRAS.values() for package in extra.packages]
    with ThreadPoolExecutor() as beside:
        opengl = beside.submit(find_opengl_here)
        seen = ask_jax(machine)
    return SystemInfo(
        machine=machine,
        jax=seen,
        opengl=opengl.result(),
        versions=versions_of((*REQUIRED, *_OPTIONAL, *extras)),
        variables=dict(os.environ),
        nvml_error=nvml_problem(),
        mps_error=try_mps(machine),
        wanted_warp=pinned_version("mujoco-mjx", "warp-lang"),
    )


def device_of(gpu: Gpu) -> str | None:
    """UUID that a process gets for a GPU, None if it cannot be used."""
    if gpu.compute_mode == "prohibited":
        return None
    if not gpu.mig_enabled:
        return gpu.uuid
    return gpu.instances[0].uuid if gpu.instances else None


def ask_jax(machine: Machine) -> JaxView:
    """Asks jax in a child with the devices that GMIs would get."""
    devices = [device for gpu in machine.gpus if (device := device_of(gpu))]
    # CUDA shows one MIG instance to a process, and no whole GPU beside it.
    seen = devices[:1] if any(device.startswith("MIG-") for device in devices) else devices
    own = without_breaking(os.environ)
    environment = {k: v for k, v in own.items() if k not in _CUDA_VARIABLES} | {
        "CUDA_VISIBLE_DEVICES": ",".join(seen),
        "JAX_PLATFORMS": "cuda" if seen else "cpu",
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    }
    try:
        done = subprocess.run(
            command("gmijax.workers.jax_probe"),
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=PROBE_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return JaxView(None, error=f"no answer within {PROBE_TIMEOUT_S:g} s")
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        return JaxView(None, error=lines[-1] if lines else f"exit code {done.returncode}")
    probe = json.loads(done.stdout.strip().splitlines()[-1])
    return JaxView(probe["platform"], tuple(probe["devices"]))


def try_mps(machine: Machine) -> str | None:
    """Starts an MPS daemon as a job would and ends it again; the error, None if there is none.

    Not tried where MPS is not installed, a daemon runs already, or no GPU can take one.
    """
    whole = [gpu for gpu in machine.gpus if device_of(gpu) and not gpu.mig_enabled]
    if machine.mps_control is None or machine.operator_daemon is not None or not whole:
        return None
    config = PlanConfig(gpus=(whole[0].index,), backend="mps")
    with tempfile.TemporaryDirectory() as scratch:
        try:
            plan = make_plan(config, ReduceConfig(), 1, machine)
            with MpsBackend(plan, machine, RunPaths(Path(scratch))):
                return None
        except GmijaxError as error:
            return str(error)
