"""What this machine can do for gmijax, what it cannot, and why: a pure function of its system."""

from __future__ import annotations

import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from gmijax.config import BackendName, StrategyName
from gmijax.control.features import features
from gmijax.control.system_info import REQUIRED, SystemInfo, device_of
from gmijax.errors import ConfigError
from gmijax.machine.mps_control import PIPE_VARIABLE
from gmijax.machine.snapshot import Machine
from gmijax.partition.backend_choice import why_not_backend
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import (
    LEAST_BINDINGS,
    why_not_intra,
    why_not_strategy,
    why_not_under,
)
from gmijax.sim.impl import ON_GPU, choose_impl
from gmijax.sim.registry import SUITES, require_task, task_names
from gmijax.version import numbers_of, versions_of

_CUDA_13_DRIVER: Final = 580
"""CUDA 13 needs a driver of this branch."""


BINDINGS: Final[Mapping[int, str]] = MappingProxyType(
    {12: f">={'.'.join(map(str, LEAST_BINDINGS))},<13", 13: ">=13"}
)
"""Which cuda-bindings the extras `cuda12` and `cuda13` bring: earlier ones hold the GIL."""


class Ability(NamedTuple):
    """Something that gmijax has, and whether it can be used here."""

    kind: str  # `backend`, `reducer`, `intra`, `physics`, `env` or `extra`.
    name: str  # As the configuration has it.
    usable: bool  # Whether it can be used.
    why: str  # The reason, or what to know about it.


@dataclass(frozen=True)
class Diagnosis:
    """The answer."""

    system: SystemInfo  # What it is made from.
    abilities: tuple[Ability, ...]  # What can be used and what not.
    # What is broken and should work, one sentence each; none on a healthy machine.
    problems: tuple[str, ...]
    notes: tuple[str, ...]  # What is worth knowing.

    def to_dict(self) -> dict[str, Any]:
        """Plain data for `--json`."""
        machine = self.system.machine
        return {
            "ok": not self.problems,
            **versions_of(("gmijax", "python")),
            "cpu_cores": len(machine.cpu_cores),
            "driver": machine.driver_version,
            "gpus": [
                gpu._asdict() | {"instances": [one._asdict() for one in gpu.instances]}
                for gpu in machine.gpus
            ],
            "mps": {
                "control": str(machine.mps_control) if machine.mps_control else None,
                "daemon": str(machine.operator_daemon) if machine.operator_daemon else None,
                "error": self.system.mps_error,
            },
            "jax": self.system.jax._asdict(),
            "versions": dict(self.system.versions),
            "abilities": [ability._asdict() for ability in self.abilities],
            "problems": list(self.problems),
            "notes": list(self.notes),
        }


def diagnose(system: SystemInfo) -> Diagnosis:
    """What can be used, what is broken, what is worth knowing."""
    return Diagnosis(
        system, tuple(_abilities(system)), tuple(_problems(system)), tuple(_notes(system))
    )


def _abilities(system: SystemInfo) -> Iterator[Ability]:
    machine = system.machine
    usable: list[BackendName] = []
    for name in typing.get_args(BackendName):
        reason = why_not_backend(name, machine)
        if name == "mps" and reason is None:
            reason = system.mps_error
        if reason is None:
            usable.append(name)
        yield Ability("backend", name, reason is None, reason or _about_backend(name, machine))
    for name in typing.get_args(StrategyName):
        yield _reducer(name, len(machine.gpus) or 2, usable)
    for name in ("host", "ipc"):
        reasons = {backend: why_not_intra(name, backend) for backend in usable}
        fine = [backend for backend, reason in reasons.items() if reason is None]
        why = f"with {', '.join(fine)}" if fine else next(iter(reasons.values())) or ""
        yield Ability("intra", name, bool(fine), why)
    platform = "gpu" if machine.gpus else "cpu"
    for name in ("jax", "warp"):
        yield _physics(name, platform, system.versions["warp-lang"] is not None)
    yield Ability("env", "gmijax", True, ", ".join(task_names()))
    for suite in SUITES:
        yield _suite(suite)
    for feature in features(system.versions, system.opengl):
        yield Ability("extra", *feature)


def _about_backend(name: str, machine: Machine) -> str:
    if name == "mps":
        return f"daemon: {machine.operator_daemon or 'one of its own for each GPU'}"
    if name == "mig":
        return "; ".join(
            f"GPU {gpu.index}: {', '.join(one.profile for one in gpu.instances)}"
            for gpu in machine.gpus
            if gpu.instances
        )
    if name == "cpu":
        return f"virtual GPUs on {len(machine.cpu_cores)} cores"
    return "GMIs of a GPU take turns"


def _reducer(name: str, num_gpus: int, backends: Sequence[BackendName]) -> Ability:
    layouts = [Layout.even(num_gpus, per_gpu) for per_gpu in (2, 1)]
    fitting = [layout for layout in layouts if why_not_strategy(name, layout) is None]
    if not fitting:
        reason = why_not_strategy(name, layouts[-1])
        return Ability("reducer", name, False, f"with layout {layouts[-1]}: {reason}")
    reasons = [why_not_under(name, fitting[0], backend) for backend in backends]
    if None in reasons:
        return Ability("reducer", name, True, f"e.g. with layout {fitting[0]}")
    return Ability("reducer", name, False, next(filter(None, reasons), "no backend works"))


def _physics(name: str, platform: str, has_warp: bool) -> Ability:
    try:
        choose_impl(name, platform, warp_installed=has_warp)
    except ConfigError as error:
        return Ability("physics", name, False, str(error).partition(": ")[2])
    tasks = [
        task
        for task in task_names()
        if choose_impl("auto", platform, task, warp_installed=has_warp)[0] == name
    ]
    return Ability("physics", name, True, f"auto chooses it for {', '.join(tasks) or 'no task'}")


def _suite(suite: str) -> Ability:
    if suite == "custom":
        return Ability("env", suite, True, "env=PATH.py:FUNCTION")
    try:
        require_task("", suite)
    except ConfigError as error:
        return Ability("env", suite, False, str(error).partition(": ")[2])
    return Ability("env", suite, True, f"env={suite} env.name=...")


def _problems(system: SystemInfo) -> Iterator[str]:
    if system.machine.selection_problem:
        yield system.machine.selection_problem
    if system.nvml_error:
        yield f"NVML is installed and does not work: {system.nvml_error}"
    for name in REQUIRED:
        if system.versions[name] is None:
            yield f"the package {name} is not installed (pip install gmijax)"
    yield from _jax_problems(system)
    for gpu in system.machine.gpus:
        if gpu.mig_enabled and not gpu.instances:
            yield (
                f"GPU {gpu.index} is in MIG mode and has no instance, so nothing can use it "
                "(gmijax doctor mig=3g,2g,1g,1g prints how to make some)"
            )
        if gpu.compute_mode == "prohibited":
            yield f"GPU {gpu.index} is in compute mode PROHIBITED (nvidia-smi -c 0)"


def _jax_problems(system: SystemInfo) -> Iterator[str]:
    usable = [gpu for gpu in system.machine.gpus if device_of(gpu)]
    num_seen = len(system.jax.devices)
    if system.jax.error and usable:
        plugins = [system.versions[f"jax-cuda{cuda}-plugin"] for cuda in (12, 13)]
        advice = "" if any(plugins) else f" (pip install 'gmijax[cuda{_cuda_major(system)}]')"
        yield f"jax cannot use the GPUs that NVML lists: {system.jax.error}{advice}"
    elif system.jax.error:
        yield f"jax does not work: {system.jax.error}"
    elif usable and not any(gpu.instances for gpu in usable) and num_seen != len(usable):
        yield f"jax sees {num_seen} GPUs, and NVML lists {len(usable)}"


def _notes(system: SystemInfo) -> Iterator[str]:
    machine, variables = system.machine, system.variables
    if "CUDA_VISIBLE_DEVICES" in variables:
        indices = [gpu.index for gpu in machine.gpus]
        yield (
            f"CUDA_VISIBLE_DEVICES={variables['CUDA_VISIBLE_DEVICES']} leaves the GPUs {indices}"
        )
    if variables.get(PIPE_VARIABLE) and machine.gpus and machine.operator_daemon is None:
        yield (
            f"{PIPE_VARIABLE}={variables[PIPE_VARIABLE]}: no daemon answers there; jobs start "
            "their own"
        )
    yield from _missing_pieces(system)
    mujoco, mjx = system.versions["mujoco"], system.versions["mujoco-mjx"]
    if mujoco and mjx and mujoco.partition(".")[0] != mjx.partition(".")[0]:
        yield (
            f"mujoco {mujoco} with mujoco-mjx {mjx} was never tried "
            "(pip install 'mujoco~=3.17' 'mujoco-mjx~=3.17')"
        )
    if system.mps_error:
        yield "with plan.backend=auto jobs fall back to share, because MPS does not start"
    for gpu in machine.gpus:
        if gpu.compute_mode == "exclusive":
            yield f"GPU {gpu.index} is in compute mode EXCLUSIVE_PROCESS: several GMIs need MPS"


def _cuda_major(system: SystemInfo) -> int:
    """The CUDA that packages are to be for: what jax has, if the driver takes it."""
    if system.machine.driver_major < _CUDA_13_DRIVER:
        return 12
    has_12, has_13 = (system.versions.get(f"jax-cuda{cuda}-plugin") for cuda in (12, 13))
    return 12 if has_12 and not has_13 else 13


def _missing_pieces(system: SystemInfo) -> Iterator[str]:
    """What GMIs lack to train as fast as they can, and the command that brings it."""
    usable = [gpu for gpu in system.machine.gpus if device_of(gpu)]
    if not usable:
        return
    if any(not gpu.mig_enabled for gpu in usable):
        yield from _bindings(system)
        if system.machine.mps_control is None:
            yield (
                "GMIs of a GPU take turns, because nvidia-cuda-mps-control is not installed: it "
                "comes with the NVIDIA driver, into containers with its capability compute"
            )
    yield from _warp(system)


def _bindings(system: SystemInfo) -> Iterator[str]:
    cuda = _cuda_major(system)
    found = system.versions.get("cuda-bindings")
    if found is not None and bindings_fit(found, cuda):
        return
    state = f"{found} is installed" if found else "it is not installed"
    yield (
        "GMIs on GPUs cannot train together: their exchanges need "
        f"cuda-bindings{BINDINGS[cuda]}, and {state} (pip install 'gmijax[cuda{cuda}]')"
    )


def _warp(system: SystemInfo) -> Iterator[str]:
    found, wanted = system.versions.get("warp-lang"), system.wanted_warp
    command = "(pip install 'gmijax[warp]')"
    if found is None:
        faster = ", ".join(sorted(ON_GPU))
        yield f"MJX-Warp is the faster physics for {faster}: needs warp-lang {command}"
    elif wanted is not None and found != wanted:
        yield f"MJX-Warp was made for warp-lang {wanted}, and {found} is installed {command}"


def bindings_fit(version: str, cuda: int) -> bool:
    """Whether this cuda-bindings is in `BINDINGS` of a CUDA."""
    numbers = numbers_of(version)
    return numbers >= (13,) if cuda == 13 else LEAST_BINDINGS <= numbers < (13,)
