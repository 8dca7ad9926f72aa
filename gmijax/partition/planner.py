"""Makes the plan of a job: pure functions of the configuration and the machine."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from gmijax.config import PlanConfig, ReduceConfig
from gmijax.errors import BackendUnavailable, ConfigError
from gmijax.partition.layout import Layout
from gmijax.partition.machine import Machine
from gmijax.partition.nvidia import Gpu
from gmijax.partition.plan import BackendName, Plan, Slice
from gmijax.partition.reduction import (
    needs_ring,
    require_strategy,
    select_strategy,
    why_not_intra,
)

DEFAULT_MEMORY_FRACTION = 0.8
"""Part of a GPU's memory that its GMIs reserve together."""

HALF_PRECISION_HAZARD_PERCENT = ((14, 22), (28, 46), (52, 89))
"""SM caps at which wrong half-precision products were reported (H200, driver 580)."""

_CLIENTS_OF_OLD_DRIVERS, _CLIENTS_OF_NEW_DRIVERS, _NEW_DRIVER = 48, 60, 590


def make_plan(plan: PlanConfig, reduce: ReduceConfig, num_envs: int, machine: Machine) -> Plan:
    """Decides everything that is `auto` and checks the rest against the machine.

    Args:
      plan: what the user wants.
      reduce: how gradients are to be averaged.
      num_envs: N, environments per GMI.
      machine: what there is.

    Returns:
      The plan; its `reasons` say what was decided and why, one sentence each.

    Raises:
      BackendUnavailable: the wanted backend cannot be had on this machine.
      ConfigError: a value that does not fit the machine or the backend.
    """
    layout = _layout(plan)
    reasons: list[str] = []
    backend = _backend(plan, layout, machine, reasons)
    gpus = _choose_gpus(plan, layout, machine, reasons) if backend != "cpu" else ()
    _check_sm_percent(plan.sm_percent, backend, reasons)
    if backend == "mps":
        _check_num_clients(layout, machine)
    return Plan(
        layout=layout,
        slices=_slices(plan, layout, gpus, machine.cpu_cores, reasons),
        backend=backend,
        template=_template(plan, reasons),
        num_envs_per_gmi=num_envs,
        strategy=_strategy(reduce, layout, reasons),
        intra=_intra(reduce, layout, backend, reasons),
        reasons=tuple(reasons),
    )


def split_cores(cores: Sequence[int], num_gmis: int) -> tuple[tuple[int, ...], ...]:
    """Cores of every GMI: contiguous and disjoint, or one each in turn if there are too few."""
    if len(cores) < num_gmis:
        return tuple((cores[gmi % len(cores)],) for gmi in range(num_gmis))
    bounds = [gmi * len(cores) // num_gmis for gmi in range(num_gmis + 1)]
    return tuple(tuple(cores[low:high]) for low, high in pairwise(bounds))


def _layout(plan: PlanConfig) -> Layout:
    num_gpus = plan.gpus if isinstance(plan.gpus, int) else len(plan.gpus)
    if plan.layout is None:
        return Layout.even(num_gpus, plan.gmis_per_gpu)
    layout = Layout(plan.layout)
    if not isinstance(plan.gpus, int) and num_gpus != layout.num_gpus:
        raise ConfigError(
            f"plan.gpus={list(plan.gpus)}: plan.layout has {layout.num_gpus} GPUs, "
            f"so give {layout.num_gpus} indices or none"
        )
    return layout


def _backend(
    plan: PlanConfig, layout: Layout, machine: Machine, reasons: list[str]
) -> BackendName:
    if plan.backend == "auto":
        backend, reason = _choose_backend(plan, layout, machine)
        reasons.append(f"backend {backend}: {reason}")
        return backend
    _check_backend(plan.backend, machine)
    return plan.backend


def _choose_backend(plan: PlanConfig, layout: Layout, machine: Machine) -> tuple[BackendName, str]:
    if not machine.gpus:
        return "cpu", "no usable NVIDIA GPU here, so GPUs are virtual"
    most = max(len(gmis) for gmis in layout.gmis_of_gpu)
    if most == 1 and plan.sm_percent is None:
        return "share", "one GMI on every GPU has nothing to share, and MPS would only add risk"
    if machine.mps_control is not None:
        daemon = "the daemon that runs here" if machine.operator_daemon else "an own daemon"
        return "mps", f"up to {most} GMIs on a GPU run at the same time with {daemon}"
    return "share", (
        f"nvidia-cuda-mps-control is not installed, so the {most} GMIs of a GPU take turns; "
        "with MPS they were 2.0 to 2.9 times as fast"
    )


def _check_backend(backend: BackendName, machine: Machine) -> None:
    possible = ["auto", "cpu"]
    if machine.gpus:
        possible += ["share"] + (["mps"] if machine.mps_control else [])
    if backend in possible:
        return
    why = {
        "mig": "MIG instances are not supported yet",
        "mps": "nvidia-cuda-mps-control was not found in PATH or /usr/local/nvidia/bin",
        "share": "",
    }[backend]
    if backend != "mig" and not machine.gpus:
        why = "no usable NVIDIA GPU here"
    raise BackendUnavailable(
        f"plan.backend={backend}: {why}; available here: {', '.join(possible)}"
    )


def _choose_gpus(
    plan: PlanConfig, layout: Layout, machine: Machine, reasons: list[str]
) -> tuple[Gpu, ...]:
    if isinstance(plan.gpus, int):
        chosen = _first_gpus(plan, layout.num_gpus, machine, reasons)
    else:
        by_index = {gpu.index: gpu for gpu in machine.gpus}
        if missing := [index for index in plan.gpus if index not in by_index]:
            raise ConfigError(
                f"plan.gpus={list(plan.gpus)}: no usable GPU {missing[0]}; "
                f"usable are {sorted(by_index)}"
            )
        chosen = tuple(by_index[index] for index in plan.gpus)
    if in_mig := [gpu.index for gpu in chosen if gpu.mig_enabled]:
        raise BackendUnavailable(
            f"plan.gpus: GPU {in_mig[0]} is in MIG mode, which is not supported yet; "
            "choose other GPUs or switch MIG off"
        )
    return chosen


def _first_gpus(
    plan: PlanConfig, num_gpus: int, machine: Machine, reasons: list[str]
) -> tuple[Gpu, ...]:
    """The first GPUs, those in MIG mode only if there are not enough others."""
    if num_gpus > len(machine.gpus):
        key = "plan.gpus" if plan.layout is None else "GPUs of plan.layout"
        raise ConfigError(
            f"{key}={num_gpus}: this machine has {len(machine.gpus)} usable GPUs "
            "(any number is allowed with plan.backend=cpu)"
        )
    chosen = tuple(sorted(machine.gpus, key=lambda gpu: gpu.mig_enabled))[:num_gpus]
    passed_over = [gpu.index for gpu in machine.gpus[:num_gpus] if gpu not in chosen]
    if passed_over:
        reasons.append(
            f"GPUs {[gpu.index for gpu in chosen]}: not {passed_over}, which are in MIG mode"
        )
    return chosen


def _check_sm_percent(sm_percent: float | None, backend: BackendName, reasons: list[str]) -> None:
    if sm_percent is None:
        return
    if backend != "mps":
        raise ConfigError(
            f"plan.sm_percent={sm_percent:g}: only the mps backend can cap SMs, "
            f"the backend is {backend}; use null"
        )
    if any(low <= sm_percent <= high for low, high in HALF_PRECISION_HAZARD_PERCENT):
        reasons.append(
            f"warning: with plan.sm_percent={sm_percent:g} wrong half-precision matrix products "
            "have been reported (H200, driver 580); 12, 25, 50 and 100 were clean"
        )


def _check_num_clients(layout: Layout, machine: Machine) -> None:
    new = machine.driver_major >= _NEW_DRIVER
    limit = _CLIENTS_OF_NEW_DRIVERS if new else _CLIENTS_OF_OLD_DRIVERS
    most = max(len(gmis) for gmis in layout.gmis_of_gpu)
    if most > limit:
        raise ConfigError(
            f"plan.gmis_per_gpu={most}: MPS of driver {machine.driver_version} allows at most "
            f"{limit} processes on a GPU"
        )


def _slices(
    plan: PlanConfig,
    layout: Layout,
    gpus: Sequence[Gpu],
    cores: Sequence[int],
    reasons: list[str],
) -> tuple[Slice, ...]:
    if not gpus:
        if plan.memory_fraction is not None:
            reasons.append("plan.memory_fraction is not used on the cpu backend")
        cores_of = split_cores(cores, layout.num_gmis)
        return tuple(
            Slice(gmi, layout.gpu_of(gmi), "cpu", None, None, cores_of[gmi]) for gmi in layout.gmis
        )
    slices: list[Slice] = []
    for gmi in layout.gmis:
        even = round(DEFAULT_MEMORY_FRACTION / len(layout.neighbours_of(gmi)), 4)
        memory_fraction = even if plan.memory_fraction is None else plan.memory_fraction
        gpu = layout.gpu_of(gmi)
        slices.append(Slice(gmi, gpu, gpus[gpu].uuid, plan.sm_percent, memory_fraction, ()))
    return tuple(slices)


def _template(plan: PlanConfig, reasons: list[str]) -> str:
    if plan.template != "auto":
        return plan.template
    reasons.append("template tcg_ex: every GMI simulates, infers and trains")
    return "tcg_ex"


def _strategy(reduce: ReduceConfig, layout: Layout, reasons: list[str]) -> str:
    if reduce.strategy != "auto":
        require_strategy(reduce.strategy, layout)
    if layout.num_gmis == 1:
        reasons.append("strategy none: one GMI has nobody to average gradients with")
        return "none"
    if reduce.strategy != "auto":
        return reduce.strategy
    choice = select_strategy(layout)
    if needs_ring(choice.strategy, layout):
        # Shown on CPUs only so far, and there host memory is faster (docs/reduction.md).
        reasons.append(
            f"strategy mpr: Algorithm 1 says {choice.strategy} ({choice.why}); rings are not "
            f"measured on GPUs yet, ask for them with reduce.strategy={choice.strategy}"
        )
        return "mpr"
    reasons.append(f"strategy {choice.strategy}: {choice.why} (Algorithm 1)")
    return choice.strategy


def _intra(reduce: ReduceConfig, layout: Layout, backend: BackendName, reasons: list[str]) -> str:
    if reduce.intra != "auto":
        if reason := why_not_intra(reduce.intra, backend):
            raise ConfigError(
                f"reduce.intra={reduce.intra}: cannot run on layout {layout}: {reason}; use host"
            )
        return reduce.intra
    reasons.append("intra host: GMIs of a GPU exchange through shared host memory")
    return "host"
