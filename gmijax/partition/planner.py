"""Makes the plan of a job: pure functions of the configuration and the machine."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Collection, Sequence
from itertools import pairwise

from gmijax.config import BackendName, PlanConfig, ReduceConfig, TemplateName
from gmijax.errors import ConfigError
from gmijax.machine.host_limits import require_room
from gmijax.machine.nvidia import Gpu
from gmijax.machine.snapshot import Machine
from gmijax.partition.backend_choice import choose_backend, choose_gpus, require_backend
from gmijax.partition.layout import Layout
from gmijax.partition.plan import Plan, Slice
from gmijax.partition.reduction import (
    is_one_per_gpu,
    needs_ring,
    require_strategy,
    select_strategy,
    why_not_intra,
    why_not_under,
)
from gmijax.partition.shares import gpu_slices, mps_priorities, sm_percents
from gmijax.partition.templates import DESCRIPTIONS, TRAINER, Group, group_of, roles_of

_CLIENTS_OF_OLD_DRIVERS, _CLIENTS_OF_NEW_DRIVERS, _NEW_DRIVER = 48, 60, 590
_SLICES_OF_A_GPU = 7

_NO_RINGS_ON_CPU = (
    "between virtual GPUs host memory is faster than any ring, ask for it with reduce.strategy={}"
)
"""Backends that take host memory where Algorithm 1 says rings, and why."""


def make_plan(
    plan: PlanConfig,
    reduce: ReduceConfig,
    num_envs: int,
    machine: Machine,
    *,
    template: TemplateName = "tcg_ex",
    trainers: Collection[int] = (),
) -> Plan:
    """Decides everything that is `auto` and checks the rest against the machine.

    Args:
      plan: what the user wants.
      reduce: how gradients are to be averaged.
      num_envs: N, environments per GMI.
      machine: what there is.
      template: what `plan.template=auto` means.
      trainers: ids of the GMIs that train, for the template `decoupled`.

    Returns:
      The plan; its `reasons` say what was decided and why, one sentence each.

    Raises:
      BackendUnavailable: the wanted backend cannot be had on this machine.
      ConfigError: a value that does not fit the machine or the backend.
    """
    require_host(*num_gmis_of(plan), plan, machine)
    layout = _layout(plan)
    reasons: list[str] = list(machine.warnings)
    chosen = template if plan.template == "auto" else plan.template
    backend = _backend(plan, layout, machine, chosen in ("tcg", "tdg"), reasons)
    gpus = choose_gpus(plan, layout, machine, backend, reasons) if backend != "cpu" else ()
    slices = _slices(plan, layout, gpus, backend, machine, reasons)
    if plan.template == "auto":
        reasons.append(f"template {chosen}: {DESCRIPTIONS[chosen]}")
    roles = roles_of(chosen, layout, trainers)
    training = group_of(layout, roles, TRAINER)
    first = mps_priorities(plan, layout, backend, training.gmis if training else ())
    slices = tuple(
        dataclasses.replace(share, priority=priority)
        for share, priority in zip(slices, first, strict=True)
    )
    strategy, intra = "none", "host"
    if training is not None:
        strategy = _strategy(reduce, training, backend, reasons)
        intra = _intra(reduce, strategy, layout, backend, reasons)
    return Plan(
        layout=layout,
        slices=slices,
        backend=backend,
        template=chosen,
        num_envs_per_gmi=num_envs,
        strategy=strategy,
        intra=intra,
        reasons=tuple(reasons),
        roles=roles,
        self_check=_self_check(plan, slices, backend, machine),
        may_share=plan.backend == "auto"
        and backend == "mps"
        and not plan.needs_mps
        and all(gpu.compute_mode == "default" for gpu in gpus),
    )


def require_host(num_gmis: int, what: str, plan: PlanConfig, machine: Machine) -> None:
    """Raises ConfigError if a job, by its settings `what`, has more GMIs than the host takes."""
    on_cpu = plan.backend == "cpu" or not machine.gpus
    require_room(num_gmis, what, machine.host, len(machine.cpu_cores), on_cpu=on_cpu)


def num_gmis_of(plan: PlanConfig) -> tuple[int, str]:
    """How many GMIs a job has, and the settings that say so; before there is a layout."""
    if plan.layout is not None:
        return sum(map(len, plan.layout)), "plan.layout"
    num_gpus, each = plan.num_gpus, plan.gmis_per_gpu
    if each == "auto":
        raise ConfigError("plan.gmis_per_gpu=auto: not decided yet; expected an integer")
    gpus = f", plan.gpus={num_gpus}" if num_gpus > 1 else ""
    return num_gpus * each, f"plan.gmis_per_gpu={each}{gpus}"


def split_cores(cores: Sequence[int], num_gmis: int) -> tuple[tuple[int, ...], ...]:
    """Cores of every GMI: contiguous and disjoint, or one each in turn if there are too few."""
    if len(cores) < num_gmis:
        return tuple((cores[gmi % len(cores)],) for gmi in range(num_gmis))
    bounds = [gmi * len(cores) // num_gmis for gmi in range(num_gmis + 1)]
    return tuple(tuple(cores[low:high]) for low, high in pairwise(bounds))


def _layout(plan: PlanConfig) -> Layout:
    if plan.layout is None:
        assert plan.gmis_per_gpu != "auto"
        return Layout.even(plan.num_gpus, plan.gmis_per_gpu)
    layout = Layout(plan.layout)
    if not isinstance(plan.gpus, int) and len(plan.gpus) != layout.num_gpus:
        raise ConfigError(
            f"plan.gpus={list(plan.gpus)}: plan.layout has {layout.num_gpus} GPUs, "
            f"so give {layout.num_gpus} indices or none"
        )
    return layout


def _backend(
    plan: PlanConfig, layout: Layout, machine: Machine, serves: bool, reasons: list[str]
) -> BackendName:
    if plan.backend == "auto":
        backend, reason = choose_backend(plan, layout, machine, serves=serves)
        reasons.append(f"backend {backend}: {reason}")
        return backend
    require_backend(plan.backend, machine)
    return plan.backend


def _check_num_clients(
    slices: Sequence[Slice], gpus: Sequence[Gpu], backend: BackendName, machine: Machine
) -> None:
    if backend not in ("mps", "mig"):
        return
    new = machine.driver_major >= _NEW_DRIVER
    whole = _CLIENTS_OF_NEW_DRIVERS if new else _CLIENTS_OF_OLD_DRIVERS
    profiles = {one.uuid: one.profile for gpu in gpus for one in gpu.instances}
    for device, most in Counter(share.device for share in slices).items():
        limit, where = whole, "a GPU"
        if backend == "mig":
            # The driver lowers the limit in proportion to the instance.
            part = int((re.search(r"(\d)g", profiles[device]) or ["1", "1"])[1])
            limit = max(1, whole * part // _SLICES_OF_A_GPU)
            where = f"a MIG instance {profiles[device]}"
        if most > limit:
            raise ConfigError(
                f"plan.gmis_per_gpu={most}: MPS of driver {machine.driver_version} allows at "
                f"most {limit} processes on {where}"
            )


def _slices(
    plan: PlanConfig,
    layout: Layout,
    gpus: Sequence[Gpu],
    backend: BackendName,
    machine: Machine,
    reasons: list[str],
) -> tuple[Slice, ...]:
    caps = sm_percents(plan, layout, gpus, backend, reasons)
    if backend != "cpu":
        slices = gpu_slices(plan, layout, gpus, caps, backend)
        _check_num_clients(slices, gpus, backend, machine)
        return slices
    if plan.memory_fraction is not None:
        reasons.append("plan.memory_fraction is not used on the cpu backend")
    cores_of = split_cores(machine.cpu_cores, layout.num_gmis)
    return tuple(
        Slice(gmi, layout.gpu_of(gmi), "cpu", None, None, cores_of[gmi]) for gmi in layout.gmis
    )


def _self_check(
    plan: PlanConfig, slices: Sequence[Slice], backend: BackendName, machine: Machine
) -> bool:
    if plan.self_check != "auto":
        return plan.self_check == "on"
    # A daemon of somebody else may cap all its clients by default, and does not tell.
    is_theirs = backend == "mps" and machine.operator_daemon is not None
    return is_theirs or any((share.sm_percent or 100.0) < 100.0 for share in slices)


def _strategy(
    reduce: ReduceConfig, training: Group, backend: BackendName, reasons: list[str]
) -> str:
    """How those that train average gradients; `none` if there is only one."""
    layout = training.layout
    if reduce.strategy != "auto":
        require_strategy(reduce.strategy, layout, backend)
    if layout.num_gmis == 1:
        reasons.append("strategy none: one GMI has nobody to average gradients with")
        return "none"
    if reduce.strategy != "auto":
        return reduce.strategy
    choice = select_strategy(layout)
    no_ring = why_not_under(choice.strategy, layout, backend)
    if backend == "cpu" and needs_ring(choice.strategy, layout):
        no_ring = _NO_RINGS_ON_CPU.format(choice.strategy)
    no_one_shot = why_not_under("one_shot", layout, backend)
    # With one GMI on each GPU one ring over all is as fast.
    wants_one_shot = no_ring is not None or not is_one_per_gpu(layout)
    wants_one_shot &= reduce.selection == "device" and reduce.intra != "host"
    if wants_one_shot and no_one_shot is None:
        reasons.append(
            "strategy one_shot: GMIs that share GPUs train faster with exchanges on them; "
            f"Algorithm 1 says {choice.strategy} ({choice.why}), as reduce.selection=paper does"
        )
        return "one_shot"
    slow = ""
    # Under other backends there is no memory of a GPU to share, whatever is installed.
    if wants_one_shot and backend in ("mps", "share"):
        slow = f"; one_shot would train faster: {no_one_shot}"
    if no_ring is not None:
        reasons.append(
            f"strategy mpr: Algorithm 1 says {choice.strategy} ({choice.why}); {no_ring}{slow}"
        )
        return "mpr"
    reasons.append(f"strategy {choice.strategy}: {choice.why} (Algorithm 1){slow}")
    return choice.strategy


def _intra(
    reduce: ReduceConfig, strategy: str, layout: Layout, backend: BackendName, reasons: list[str]
) -> str:
    if reduce.intra != "auto":
        if reason := why_not_intra(reduce.intra, backend):
            raise ConfigError(
                f"reduce.intra={reduce.intra}: cannot run on layout {layout}: {reason}; use host"
            )
        return reduce.intra
    if reason := why_not_intra("ipc", backend):
        reasons.append(f"intra host: GMIs of a GPU exchange through shared host memory; {reason}")
        return "host"
    if strategy != "one_shot":
        reasons.append("intra ipc: with har GMIs of a GPU exchange through memory of the GPU")
    return "ipc"
