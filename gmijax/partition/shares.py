"""How much of its GPU a GMI gets: SM caps, memory fractions, MIG instances. Pure functions.

Which SM caps are safe, and how that was found out: docs/shares.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from typing import Final

from gmijax.config import BackendName, PlanConfig, Priority
from gmijax.errors import ConfigError
from gmijax.machine.nvidia import Gpu, MigInstance
from gmijax.partition.layout import Layout
from gmijax.partition.plan import Slice

DEFAULT_MEMORY_FRACTION: Final = 0.8
"""Part of a GPU's (or MIG instance's) memory that its GMIs reserve together."""

CLEAN_SM_PERCENT: Final = ((1, 13), (23, 27), (47, 51), (90, 100))
"""SM caps at which no wrong half-precision products were reported (H200, driver 580)."""

_HOPPER: Final = 9


def sm_percents(
    plan: PlanConfig, layout: Layout, gpus: Sequence[Gpu], backend: BackendName, reasons: list[str]
) -> tuple[float | None, ...]:
    """The SM cap of every GMI in percent, in order of id; None for no cap.

    Args:
      plan: what the user wants; `even` is 100 / GMIs of the GPU, or the next clean value above.
      layout: which GMI is where.
      gpus: the GPUs of the job; none on the cpu backend.
      backend: only `mps` can cap.
      reasons: takes a sentence on what was decided.

    Raises:
      ConfigError: a backend that cannot, not one value per GMI, or a cap at which wrong results
        were reported, unless `plan.force_sm_percent`.
    """
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
        _check_cap(cap, gpus[layout.gpu_of(gmi)], plan.force_sm_percent, reasons)
    return caps


def mps_priorities(
    plan: PlanConfig, layout: Layout, backend: BackendName, trainers: Collection[int]
) -> tuple[Priority | None, ...]:
    """The priority of every GMI's kernels, in order of id; None where all are alike.

    Raises:
      ConfigError: a backend that cannot, not one value per GMI, or nobody to put first.
    """
    wanted = plan.mps_priority
    if wanted is None:
        return (None,) * layout.num_gmis
    what = f"plan.mps_priority={_shown(wanted)}"
    if backend != "mps":
        raise ConfigError(f"{what}: only the mps backend has it, the backend is {backend}")
    if wanted != "trainers_first":
        if len(wanted) != layout.num_gmis:
            raise ConfigError(f"{what}: {len(wanted)} values for {layout.num_gmis} GMIs")
        return wanted
    if len(trainers) in (0, layout.num_gmis):
        raise ConfigError(
            f"{what}: needs GMIs that train and GMIs that do not (algo=a3c, "
            "plan.template=tdg_ex), here all are alike"
        )
    return tuple("normal" if gmi in trainers else "below_normal" for gmi in layout.gmis)


def is_clean(sm_percent: float) -> bool:
    """Whether no wrong results were reported at this cap."""
    return any(low <= sm_percent <= high for low, high in CLEAN_SM_PERCENT)


def gpu_slices(
    plan: PlanConfig,
    layout: Layout,
    gpus: Sequence[Gpu],
    caps: Sequence[float | None],
    backend: BackendName,
) -> tuple[Slice, ...]:
    """The share of every GMI on a GPU, in order of id.

    Raises:
      ConfigError: not one memory fraction per GMI.
    """
    homes = _instances_of(layout, gpus) if backend == "mig" else (None,) * layout.num_gmis
    memory = [
        (layout.gpu_of(gmi), home.gpu_instance if home else None) for gmi, home in enumerate(homes)
    ]
    sharing = Counter(memory)
    given = (
        None
        if plan.memory_fraction is None
        else _one_each("plan.memory_fraction", plan.memory_fraction, layout)
    )
    slices: list[Slice] = []
    for gmi, home in enumerate(homes):
        gpu = layout.gpu_of(gmi)
        even = round(DEFAULT_MEMORY_FRACTION / sharing[memory[gmi]], 4)
        slices.append(
            Slice(
                gmi=gmi,
                gpu=gpu,
                device=home.uuid if home else gpus[gpu].uuid,
                sm_percent=caps[gmi],
                memory_fraction=given[gmi] if given else even,
                cpus=(),
            )
        )
    return tuple(slices)


def assign_instances(num_sms: Sequence[int], num_gmis: int) -> tuple[int, ...]:
    """Places in `num_sms` (SMs of the instances of a GPU) of its GMIs, in order.

    Every GMI gets an instance of its own while there are any, the largest first. Each further
    one goes where it leaves most SMs to each GMI.
    """
    load = [0] * len(num_sms)
    chosen: list[int] = []
    for _ in range(num_gmis):
        best = max(
            range(len(num_sms)),
            key=lambda place: (load[place] == 0, num_sms[place] / (load[place] + 1), -place),
        )
        load[best] += 1
        chosen.append(best)
    return tuple(chosen)


def _instances_of(layout: Layout, gpus: Sequence[Gpu]) -> tuple[MigInstance, ...]:
    """The MIG instance of every GMI, in order of id."""
    homes: dict[int, MigInstance] = {}
    for gpu, gmis in zip(gpus, layout.gmis_of_gpu, strict=True):
        places = assign_instances([one.num_sms for one in gpu.instances], len(gmis))
        homes |= {gmi: gpu.instances[place] for gmi, place in zip(gmis, places, strict=True)}
    return tuple(homes[gmi] for gmi in layout.gmis)


def _even_percent(num_gmis: int, gpu: Gpu) -> float:
    even = round(100 / num_gmis, 1)
    if not _is_hopper(gpu) or is_clean(even):
        return even
    # A cap is no reservation: a little more for each does no harm, wrong results do.
    return float(min(low for low, _ in CLEAN_SM_PERCENT if low > even))


def _check_cap(cap: float, gpu: Gpu, is_forced: bool, reasons: list[str]) -> None:
    if not _is_hopper(gpu) or is_clean(cap):
        return
    clean = ", ".join(f"{low}-{high}" for low, high in CLEAN_SM_PERCENT)
    what = (
        f"plan.sm_percent={cap:g}: wrong half-precision matrix products were reported at this "
        f"cap (H200, driver 580), see docs/shares.md; clean are {clean}"
    )
    if not is_forced:
        raise ConfigError(f"{what}; plan.force_sm_percent=true takes it all the same")
    if (warning := f"warning: {what}") not in reasons:
        reasons.append(warning)


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
