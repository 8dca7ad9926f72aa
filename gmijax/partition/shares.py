"""How much a GMI gets: SM caps, memory fractions, MIG instances, cores. Pure functions.

Which SM caps are safe, and how that was found out: docs/shares.md.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from gmijax.config import BackendName, PlanConfig
from gmijax.errors import ConfigError
from gmijax.machine.nvidia import Gpu
from gmijax.machine.snapshot import Machine
from gmijax.partition.layout import Layout
from gmijax.partition.plan import Allocation

DEFAULT_MEMORY_FRACTION: Final = 0.8
"""Part of a GPU's (or MIG instance's) memory that its GMIs reserve together."""

CLEAN_SM_PERCENT: Final = ((1, 13), (23, 27), (47, 51), (90, 100))
"""SM caps at which no wrong half-precision products were reported (H200, driver 580)."""

_HOPPER: Final = 9
_CLIENTS_OF_OLD_DRIVERS, _CLIENTS_OF_NEW_DRIVERS, _NEW_DRIVER = 48, 60, 590
_SLICES_OF_A_GPU: Final = 7


def make_allocations(
    plan: PlanConfig,
    layout: Layout,
    gpus: Sequence[Gpu],
    backend: BackendName,
    machine: Machine,
    reasons: list[str],
) -> tuple[Allocation, ...]:
    """The share of every GMI, in order of id; `gpus` are those of the job, none on `cpu`.

    Raises:
      ConfigError: a share that the backend cannot enforce, that is not safe, or is not one for
        each GMI; more GMIs on a GPU than MPS allows.
    """
    caps = _sm_percents(plan, layout, gpus, backend, reasons)
    if backend == "cpu":
        if plan.memory_fraction is not None:
            reasons.append("plan.memory_fraction is not used on the cpu backend")
        cores_of = split_cores(machine.cpu_cores, layout.num_gmis)
        return tuple(
            Allocation(gmi, layout.gpu_of(gmi), "cpu", None, None, cores_of[gmi])
            for gmi in layout.gmis
        )
    bindings = _bindings_of(layout, gpus, backend)
    if plan.memory_fraction is not None:
        memory = _one_each("plan.memory_fraction", plan.memory_fraction, layout)
    else:
        sharing = Counter(binding.memory for binding in bindings)
        memory = [
            round(DEFAULT_MEMORY_FRACTION / sharing[binding.memory], 4) for binding in bindings
        ]
    if backend in ("mps", "mig"):
        _require_client_limit(bindings, machine)
    return tuple(
        Allocation(gmi, layout.gpu_of(gmi), binding.device, caps[gmi], memory[gmi], ())
        for gmi, binding in enumerate(bindings)
    )


def split_cores(cores: Sequence[int], num_gmis: int) -> tuple[tuple[int, ...], ...]:
    """Cores of every GMI: contiguous and disjoint, or one each in turn if there are too few."""
    if len(cores) < num_gmis:
        return tuple((cores[gmi % len(cores)],) for gmi in range(num_gmis))
    bounds = [gmi * len(cores) // num_gmis for gmi in range(num_gmis + 1)]
    return tuple(tuple(cores[low:high]) for low, high in pairwise(bounds))


def is_clean(sm_percent: float) -> bool:
    """Whether no wrong results were reported at this cap."""
    return any(low <= sm_percent <= high for low, high in CLEAN_SM_PERCENT)


def assign_instances(num_sms: Sequence[int], num_gmis: int) -> tuple[int, ...]:
    """Indices into `num_sms` (SMs of the instances of a GPU) of its GMIs, in order.

    Every GMI gets an instance of its own while there are any, the largest first. Each further
    one goes to the instance where most SMs are left for each GMI.
    """
    load = [0] * len(num_sms)
    chosen: list[int] = []
    for _ in range(num_gmis):
        best = max(
            range(len(num_sms)),
            key=lambda gpu: (load[gpu] == 0, num_sms[gpu] / (load[gpu] + 1), -gpu),
        )
        load[best] += 1
        chosen.append(best)
    return tuple(chosen)


def _sm_percents(
    plan: PlanConfig, layout: Layout, gpus: Sequence[Gpu], backend: BackendName, reasons: list[str]
) -> tuple[float | None, ...]:
    """The SM cap of every GMI in percent; None for no cap."""
    wanted = plan.sm_percent
    if wanted is None:
        return (None,) * layout.num_gmis
    if backend != "mps":
        raise ConfigError(
            f"plan.sm_percent={_shown(wanted)}: only the mps backend can cap SMs, "
            f"the backend is {backend}; use null"
        )
    if wanted == "even":
        caps = tuple(
            _even_percent(len(layout.neighbours_of(gmi)), gpus[layout.gpu_of(gmi)])
            for gmi in layout.gmis
        )
        reasons.append(f"sm_percent {_shown(tuple(sorted(set(caps))))}: even shares")
        return caps
    caps = _one_each("plan.sm_percent", wanted, layout)
    for gmi, cap in enumerate(caps):
        _check_cap(cap, gpus[layout.gpu_of(gmi)])
    return caps


class _Binding(NamedTuple):
    """The device of a GMI."""

    device: str  # UUID of the GPU or of the MIG instance.
    # What it shares memory with others by: the GPU, and a GPU instance of it.
    memory: tuple[int, int | None]
    profile: str | None  # Of the MIG instance, None for a whole GPU.


def _bindings_of(layout: Layout, gpus: Sequence[Gpu], backend: BackendName) -> list[_Binding]:
    """The binding of every GMI, in order of id."""
    bindings: dict[int, _Binding] = {}
    for index, (gpu, gmis) in enumerate(zip(gpus, layout.gmis_of_gpu, strict=True)):
        if backend != "mig":
            bindings |= dict.fromkeys(gmis, _Binding(gpu.uuid, (index, None), None))
            continue
        chosen = assign_instances([one.num_sms for one in gpu.instances], len(gmis))
        for gmi, number in zip(gmis, chosen, strict=True):
            one = gpu.instances[number]
            bindings[gmi] = _Binding(one.uuid, (index, one.gpu_instance), one.profile)
    return [bindings[gmi] for gmi in layout.gmis]


def _require_client_limit(bindings: Sequence[_Binding], machine: Machine) -> None:
    new = machine.driver_major >= _NEW_DRIVER
    whole = _CLIENTS_OF_NEW_DRIVERS if new else _CLIENTS_OF_OLD_DRIVERS
    for (_, profile), most in Counter(
        (binding.device, binding.profile) for binding in bindings
    ).items():
        limit, where = whole, "a GPU"
        if profile is not None:
            # The driver lowers the limit in proportion to the instance.
            part = int((re.search(r"(\d)g", profile) or ["1", "1"])[1])
            limit = max(1, whole * part // _SLICES_OF_A_GPU)
            where = f"a MIG instance {profile}"
        if most > limit:
            raise ConfigError(
                f"plan.gmis_per_gpu={most}: MPS of driver {machine.driver_version} allows at "
                f"most {limit} processes on {where}"
            )


def _even_percent(num_gmis: int, gpu: Gpu) -> float:
    even = round(100 / num_gmis, 1)
    if not _is_hopper(gpu) or is_clean(even):
        return even
    # A cap is no reservation: a little more for each does no harm, wrong results do.
    return float(min(low for low, _ in CLEAN_SM_PERCENT if low > even))


def _check_cap(cap: float, gpu: Gpu) -> None:
    if not _is_hopper(gpu) or is_clean(cap):
        return
    clean = ", ".join(f"{low}-{high}" for low, high in CLEAN_SM_PERCENT)
    raise ConfigError(
        f"plan.sm_percent={cap:g}: wrong half-precision matrix products were reported at this "
        f"cap (H200, driver 580), see docs/shares.md; clean are {clean}"
    )


def _is_hopper(gpu: Gpu) -> bool:
    return gpu.compute_capability[0] == _HOPPER


def _one_each(key: str, wanted: float | tuple[float, ...], layout: Layout) -> tuple[float, ...]:
    if not isinstance(wanted, tuple):
        return (wanted,) * layout.num_gmis
    if len(wanted) != layout.num_gmis:
        raise ConfigError(
            f"{key}={_shown(wanted)}: {len(wanted)} values for {layout.num_gmis} GMIs; give one "
            "number, or one for each GMI"
        )
    return wanted


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{','.join(_shown(one) for one in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
