"""Slots for jobs: the allocations of a plan of GMIs that have nothing to do with each other."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from gmijax.config import BackendName, PlanConfig, ReduceConfig, TrainConfig
from gmijax.config.sweep import JobsConfig
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Allocation, Plan
from gmijax.partition.planner import make_plan


@dataclass(frozen=True)
class Slot:
    """Where a job runs.

    Attributes:
      allocations: one of each of its GPUs.
      label: in words, e.g. `GPU 0 slot 1` by the index of nvidia-smi, on a node after its
        address; without GPUs the address alone, or nothing.
      kept_idle: allocations of its GPUs that stay idle while the job runs.
      merged: allocations of its GPU, whose memory and cores the job has too.
      site: index of its machine.
      backend: of that machine's slots.
      is_whole_gpu: whether GPUs have one slot each.
      is_alone: whether no other job runs on its GPUs meanwhile.
    """

    allocations: tuple[Allocation, ...]
    label: str
    kept_idle: tuple[Allocation, ...]
    site: int
    backend: BackendName
    is_whole_gpu: bool
    is_alone: bool
    merged: tuple[Allocation, ...] = ()

    @property
    def size(self) -> int:
        """How many jobs it can hold."""
        return 1 + len(self.merged)

    @property
    def devices(self) -> tuple[str, ...]:
        """UUIDs of its GPUs or MIG instances; none on a machine without GPUs."""
        return tuple(
            allocation.device for allocation in self.allocations if allocation.device != "cpu"
        )

    @property
    def cpus(self) -> tuple[int, ...]:
        """Cores of its processes."""
        return tuple(
            sorted({cpu for one in (*self.allocations, *self.merged) for cpu in one.cpus})
        )

    def memory_fraction(self, config: TrainConfig) -> float | None:
        """For each GMI of a job that is put here; None where memory is not divided."""
        fraction = self.allocations[0].memory_fraction
        if fraction is None:
            return None
        return max(0.01, int(1e4 * self.size * fraction / gmis_per_slot(config)) / 1e4)


def gmis_per_slot(config: TrainConfig) -> int:
    """How many GMIs a job has at each of its slots."""
    plan = config.plan
    if config.is_decoupled:
        return plan.num_serving_gmis + plan.training_gmis_per_gpu
    return 1 if plan.gmis_per_gpu == "auto" else plan.gmis_per_gpu


def plan_slots(settings: JobsConfig, machine: Machine, backends: Collection[str]) -> Plan:
    """A plan whose allocations are the slots: of GMIs that have nothing to do with each other.

    Args:
      settings: of the sweep.
      machine: where it is.
      backends: `plan.backend` of the jobs; where they differ each must bring its own.
    """
    backend: Any = next(iter(backends)) if len(backends) == 1 else "auto"
    gpus, each = settings.gpus, settings.jobs_per_gpu
    if gpus is None:
        gpus = max(1, len(machine.gpus))
    try:
        count = 1 if each == "auto" else each
        # Jobs plan their own GMIs; a given template is not among the reasons that are printed.
        config = PlanConfig(gpus=gpus, gmis_per_gpu=count, backend=backend, template="tcg")
        return make_plan(config, ReduceConfig(), 1, machine, template="tcg")
    except ConfigError as error:
        text = str(error).replace("plan.gmis_per_gpu", f"{settings.prefix}jobs_per_gpu")
        raise ConfigError(text.replace("plan.gpus", f"{settings.prefix}gpus")) from None


class Site(NamedTuple):
    """A machine with slots.

    Attributes:
      plan: see `plan_slots`.
      machine: what it was made for.
      name: address of a node; None: this machine.
    """

    plan: Plan
    machine: Machine
    name: str | None = None


class SlotPool:
    """All slots of a sweep, free and taken; a job's are all on one machine.

    Args:
      sites: where they are.
    """

    def __init__(self, sites: Sequence[Site]) -> None:
        self._sites = list(sites)
        self._free = [list(site.plan.allocations) for site in sites]
        self._all = [_by_gpu(site.plan.allocations) for site in sites]
        self._labels = [_labels(site) for site in sites]
        self._limits: dict[tuple[int, int], int] = {}
        self.left = set(range(len(sites)))

    def num_gpus_with_free_slot(self, avoid: Collection[int] = ()) -> int:
        """GPUs that have a free slot, on machines other than those of `avoid`."""
        return sum(len(self._open_slots(site)) for site in self.left.difference(avoid))

    def limit(self, site: int, gpu: int, count: int) -> None:
        """From now on so many slots of a GPU may be taken; those that are taken stay so."""
        self._limits[site, gpu] = count

    def _open_slots(self, site: int) -> dict[int, list[Allocation]]:
        """Free slots by GPU, no more than its limit allows to be taken."""
        open_slots: dict[int, list[Allocation]] = {}
        for gpu, free in _by_gpu(self._free[site]).items():
            total = len(self._all[site][gpu])
            limit = self._limits.get((site, gpu), total)
            if (num_open := limit - (total - len(free))) > 0:
                open_slots[gpu] = free[:num_open]
        return open_slots

    def acquire(
        self,
        num_gpus: int,
        *,
        alone: bool = False,
        avoid: Collection[int] = (),
        num_jobs: int = 1,
    ) -> Slot | None:
        """A slot on each of `num_gpus` GPUs of a machine, those with the most free ones.

        With `alone` they are GPUs on which no other job runs, now or until it is given back. The
        machines of `avoid` are left out. None: not now. On one GPU it can hold up to `num_jobs`
        jobs.
        """
        candidates: list[tuple[int, list[list[Allocation]]]] = []
        for site in sorted(self.left.difference(avoid)):
            by_gpu = self._open_slots(site)
            if alone:
                here, free = self._all[site], _by_gpu(self._free[site])
                by_gpu = {gpu: free[gpu] for gpu in by_gpu if free[gpu] == here[gpu]}
            emptiest = sorted(by_gpu.values(), key=len, reverse=True)[:num_gpus]
            if len(emptiest) == num_gpus:
                candidates.append((site, emptiest))
        if not candidates:
            return None
        site, emptiest = max(candidates, key=lambda candidate: sum(map(len, candidate[1])))
        taken = tuple(free[0] for free in emptiest)
        # Of a GPU with MIG a job has one instance.
        rest = [
            allocation for allocation in emptiest[0][1:] if allocation.device == taken[0].device
        ]
        merged = tuple(rest[: num_jobs - 1]) if num_gpus == 1 else ()
        others = [
            allocation for free in emptiest for allocation in free[1:] if allocation not in merged
        ]
        return self._taken(site, taken, merged, tuple(others) if alone else ())

    def _taken(
        self,
        site: int,
        taken: tuple[Allocation, ...],
        merged: tuple[Allocation, ...],
        kept_idle: tuple[Allocation, ...],
    ) -> Slot:
        gone, here = (*taken, *merged, *kept_idle), self._all[site]
        self._free[site] = [
            allocation for allocation in self._free[site] if allocation not in gone
        ]
        is_alone = sum(len(here[allocation.gpu]) for allocation in taken) == len(gone)
        label = ", ".join(self._labels[site][allocation.gmi] for allocation in taken)
        return Slot(
            taken,
            f"{label} alone" if kept_idle else label,
            kept_idle,
            site,
            self._sites[site].plan.backend,
            is_whole_gpu=all(len(allocations) == 1 for allocations in here.values()),
            is_alone=is_alone,
            merged=merged,
        )

    def release(self, slot: Slot) -> None:
        """The job that was there has ended."""
        if slot.site in self.left:
            free = [*self._free[slot.site], *slot.allocations, *slot.kept_idle, *slot.merged]
            self._free[slot.site] = sorted(free, key=lambda allocation: allocation.gmi)

    def remove_site(self, site: int) -> None:
        """The machine is gone."""
        self.left.discard(site)
        self._free[site] = []


def _by_gpu(allocations: Iterable[Allocation]) -> dict[int, list[Allocation]]:
    found: dict[int, list[Allocation]] = {}
    for allocation in allocations:
        found.setdefault(allocation.gpu, []).append(allocation)
    return found


def _labels(site: Site) -> dict[int, str]:
    """Label of every slot, by GMI id."""
    index_of = site.machine.index_of_device
    node = f"{site.name} " if site.name else ""
    labels: dict[int, str] = {}
    for here in _by_gpu(site.plan.allocations).values():
        for slot, allocation in enumerate(here):
            is_gpu = allocation.device in index_of
            gpu = f"GPU {index_of[allocation.device]} slot {slot}" if is_gpu else ""
            labels[allocation.gmi] = f"{node}{gpu}".rstrip()
    return labels
