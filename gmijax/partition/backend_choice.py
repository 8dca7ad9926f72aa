"""Which backend a job gets, and which GPUs (paper, sec. 3). Pure rules.

Training takes MPS, because GMIs that learn together exchange gradients; serving takes MIG where
instances exist, because GMIs that only simulate and infer gain from being apart.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from gmijax.config import BackendName, PlanConfig
from gmijax.errors import BackendUnavailable, ConfigError
from gmijax.machine.nvidia import Gpu
from gmijax.machine.snapshot import Machine
from gmijax.partition.layout import Layout

WHAT_SHARE_LOSES: Final = (
    "the GMIs of a GPU take turns; with MPS they were 1.45 to 4.73 times as fast"
)

_VOLTA: Final = 7
_AMPERE: Final = 8


def choose_backend(
    plan: PlanConfig, layout: Layout, machine: Machine, *, serves: bool
) -> tuple[BackendName, str]:
    """The backend for `plan.backend=auto`, and why, in words; `serves`: no GMI trains.

    Raises:
      BackendUnavailable: the driver is broken, or GPUs are named that are not here: a job on a
        machine with GPUs runs without them only if that is requested.
    """
    _require_named_gpus(machine)
    if machine.gpu_problem is not None:
        raise BackendUnavailable(
            f"plan.backend=auto: the NVIDIA driver does not work: {machine.gpu_problem}; "
            "plan.backend=cpu (or CUDA_VISIBLE_DEVICES=-1) continues without GPUs"
        )
    if not machine.gpus:
        return "cpu", "no usable NVIDIA GPU here, so GPUs are virtual"
    most = max(len(gmis) for gmis in layout.gmis_of_gpu)
    if why_mig := _why_mig(plan, layout, machine, serves):
        return "mig", why_mig
    has_neighbours = any(gpu.uuid in machine.daemons for gpu in candidates(plan, machine))
    if most == 1 and plan.sm_percent is None and not has_neighbours:
        return "share", "one GMI on every GPU has nothing to share, and MPS would only add risk"
    oldest = min(gpu.compute_capability for gpu in candidates(plan, machine))
    if oldest[0] < _VOLTA:
        return "share", (
            f"warning: MPS of a GPU of compute capability {_version(oldest)} does not keep its "
            f"clients apart, so {WHAT_SHARE_LOSES}"
        )
    if machine.mps_control is None:
        return "share", (
            f"warning: nvidia-cuda-mps-control is not installed, so {WHAT_SHARE_LOSES}"
        )
    why = _why_mps(most, machine, has_neighbours=has_neighbours)
    if oldest[0] < _AMPERE:
        return "mps", f"{why}; compute capability {_version(oldest)} has no MIG"
    if serves and plan.sm_percent is not None:
        return "mps", f"{why}; only MPS can cap SMs"
    if serves:
        return "mps", f"{why}; there are no MIG instances to keep them apart"
    return "mps", f"{why}, and can exchange gradients"


def _why_mps(most: int, machine: Machine, *, has_neighbours: bool) -> str:
    if has_neighbours:
        return "the pack or sweep that this job belongs to has an MPS daemon for this GPU"
    daemon = "the daemon that runs here" if machine.operator_daemon else "a daemon of its own"
    return f"up to {most} GMIs on a GPU run at the same time with {daemon}"


def require_backend(backend: BackendName, machine: Machine) -> None:
    """Raises BackendUnavailable, with what can be had, unless the machine has `backend`."""
    if backend == "cpu":
        return
    _require_named_gpus(machine)
    if why_not_backend(backend, machine) is None:
        return
    names: tuple[BackendName, ...] = ("share", "mps", "mig")
    possible = [name for name in names if why_not_backend(name, machine) is None]
    raise BackendUnavailable(
        f"plan.backend={backend}: {why_not_backend(backend, machine)}; available here: "
        f"{', '.join(['auto', 'cpu', *possible])}"
    )


def _require_named_gpus(machine: Machine) -> None:
    if machine.selection_problem is not None:
        raise BackendUnavailable(
            f"{machine.selection_problem}; plan.backend=cpu (or CUDA_VISIBLE_DEVICES=-1) goes on "
            "without GPUs"
        )


def why_not_backend(backend: BackendName, machine: Machine) -> str | None:
    """None if `backend` can be had on this machine, else the reason in words."""
    if backend == "cpu":
        return None
    if not machine.gpus:
        return "no usable NVIDIA GPU here"
    if backend == "mig":
        return _why_no_mig(machine)
    if all(gpu.mig_enabled for gpu in machine.gpus):
        return "all GPUs are in MIG mode"
    if backend == "mps" and machine.mps_control is None:
        return "nvidia-cuda-mps-control was not found in PATH or /usr/local/nvidia/bin"
    return None


def choose_gpus(
    plan: PlanConfig,
    layout: Layout,
    machine: Machine,
    backend: BackendName,
    reasons: list[str],
) -> tuple[Gpu, ...]:
    """The GPUs of the job, in the order of the layout.

    Raises:
      ConfigError: there are not as many, or not those.
      BackendUnavailable: they cannot be used with `backend`.
    """
    chosen = candidates(plan, machine)
    if isinstance(plan.gpus, int):
        chosen = _first_gpus(plan, layout.num_gpus, machine, backend, reasons)
    for gpu, gmis in zip(chosen, layout.gmis_of_gpu, strict=True):
        if reason := _why_not_gpu(gpu, len(gmis), backend, machine):
            raise BackendUnavailable(f"plan.gpus: GPU {gpu.index} {reason}")
    return chosen


def require_num_gpus(needed: int, usable: Collection[Gpu], key: str = "plan.gpus") -> None:
    """Raises ConfigError if a job, by its setting `key`, needs more GPUs than are `usable`."""
    if needed > len(usable):
        raise ConfigError(
            f"{key}={needed}: this machine has {len(usable)} usable GPUs "
            "(any number is allowed with plan.backend=cpu)"
        )


def candidates(plan: PlanConfig, machine: Machine) -> tuple[Gpu, ...]:
    """The GPUs that the job may use: those that it names, else all.

    Raises:
      ConfigError: one of them is not there.
    """
    if isinstance(plan.gpus, int):
        return machine.gpus
    by_index = {gpu.index: gpu for gpu in machine.gpus}
    if missing := [index for index in plan.gpus if index not in by_index]:
        raise ConfigError(
            f"plan.gpus={list(plan.gpus)}: no usable GPU {missing[0]}; "
            f"usable are {sorted(by_index)}"
        )
    return tuple(by_index[index] for index in plan.gpus)


def _why_mig(plan: PlanConfig, layout: Layout, machine: Machine, serves: bool) -> str | None:
    """Why instances are taken; None if too few GPUs have any, or whole ones are better."""
    usable = candidates(plan, machine)
    divided = [gpu for gpu in usable if gpu.instances]
    if len(divided) < layout.num_gpus or plan.sm_percent is not None:
        return None
    if sum(not gpu.mig_enabled for gpu in usable) < layout.num_gpus:
        why = "the GPUs here are in MIG mode"
        faster = "; MPS on a whole GPU would let the GMIs exchange gradients faster"
        return why if serves else why + faster
    sizes = [len(gmis) for gmis in layout.gmis_of_gpu]
    is_crowded = any(size > len(gpu.instances) for size, gpu in zip(sizes, divided, strict=False))
    # One GMI alone does better with a whole GPU than with a part of one.
    if not serves or max(sizes) == 1 or (is_crowded and machine.mps_control is None):
        return None
    return "serving needs no exchange, and instances do not disturb each other"


def _why_no_mig(machine: Machine) -> str | None:
    if any(gpu.instances for gpu in machine.gpus):
        return None
    advice = "gmijax doctor mig=3g,2g,1g,1g prints how to make them"
    if any(gpu.mig_enabled for gpu in machine.gpus):
        return f"MIG mode is on, but there are no instances ({advice})"
    if any(gpu.mig_supported for gpu in machine.gpus):
        return f"no GPU is divided into MIG instances ({advice})"
    return "the GPUs here have no MIG"


def _first_gpus(
    plan: PlanConfig,
    num_gpus: int,
    machine: Machine,
    backend: BackendName,
    reasons: list[str],
) -> tuple[Gpu, ...]:
    """The first GPUs, those that the backend cannot use only if there are not enough others."""
    key = "plan.gpus" if plan.layout is None else "GPUs of plan.layout"
    require_num_gpus(num_gpus, machine.gpus, key)

    def is_unfit(gpu: Gpu) -> bool:
        return not gpu.instances if backend == "mig" else gpu.mig_enabled

    chosen = tuple(sorted(machine.gpus, key=is_unfit))[:num_gpus]
    passed_over = [gpu.index for gpu in machine.gpus[:num_gpus] if gpu not in chosen]
    if passed_over:
        why = "have no MIG instance" if backend == "mig" else "are in MIG mode"
        reasons.append(f"GPUs {[gpu.index for gpu in chosen]}: not {passed_over}, which {why}")
    return chosen


def _why_not_gpu(gpu: Gpu, num_gmis: int, backend: BackendName, machine: Machine) -> str | None:
    if gpu.compute_mode == "prohibited":
        return "is in compute mode PROHIBITED, which lets no process use it (nvidia-smi -c 0)"
    if backend == "mig":
        if not gpu.instances:
            return "has no MIG instance; see gmijax doctor"
        if num_gmis > len(gpu.instances) and machine.mps_control is None:
            return (
                f"has {len(gpu.instances)} MIG instances for {num_gmis} GMIs, and MPS, to share "
                "one, is not installed"
            )
        return None
    if gpu.mig_enabled:
        has = "use plan.backend=mig" if gpu.instances else "it has no instance"
        return f"is in MIG mode, and the backend is {backend}: {has}, or choose other GPUs"
    if backend == "share" and num_gmis > 1 and gpu.compute_mode == "exclusive":
        return (
            f"is in compute mode EXCLUSIVE_PROCESS, so without MPS it takes one GMI, not "
            f"{num_gmis}"
        )
    return None


def _version(capability: tuple[int, int]) -> str:
    return f"{capability[0]}.{capability[1]}"
