"""Places for jobs: the slices of a plan of GMIs that have nothing to do with each other."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from gmijax.config import PlanConfig, ReduceConfig, TrainConfig
from gmijax.config.sweep import SweepConfig
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan, Slice
from gmijax.partition.planner import make_plan


@dataclass(frozen=True)
class Place:
    """Where a job runs.

    Attributes:
      slices: one of each of its GPUs.
      label: in words, e.g. `GPU 0 place 1` by the index of nvidia-smi; without GPUs `place 1`.
      kept_free: others of its GPUs, where nobody else runs meanwhile.
    """

    slices: tuple[Slice, ...]
    label: str
    kept_free: tuple[Slice, ...] = ()

    @property
    def devices(self) -> tuple[str, ...]:
        """UUIDs of its GPUs or MIG instances; none on a machine without GPUs."""
        return tuple(share.device for share in self.slices if share.device != "cpu")

    @property
    def cpus(self) -> tuple[int, ...]:
        """Cores of its processes."""
        return tuple(sorted({cpu for share in self.slices for cpu in share.cpus}))

    def memory_fraction(self, config: TrainConfig) -> float | None:
        """For each GMI of a job that is put here; None where memory is not divided."""
        fraction = self.slices[0].memory_fraction
        if fraction is None:
            return None
        plan = config.plan
        gmis = (
            plan.serving_gmis_per_gpu + plan.training_gmis_per_gpu
            if config.is_asynchronous
            else 1
            if plan.gmis_per_gpu == "auto"
            else plan.gmis_per_gpu
        )
        return max(0.01, int(1e4 * fraction / gmis) / 1e4)


def places_of(settings: SweepConfig, machine: Machine, backends: Collection[str]) -> Plan:
    """A plan whose slices are the places: of GMIs that have nothing to do with each other.

    Args:
      settings: of the sweep.
      machine: where it is.
      backends: `plan.backend` of the jobs; where they differ each must bring its own.
    """
    wanted: Any = next(iter(backends)) if len(backends) == 1 else "auto"
    gpus, each = settings.gpus, settings.jobs_per_gpu
    if gpus is None:
        gpus = max(1, len(machine.gpus))
    try:
        count = 1 if each == "auto" else each
        # Jobs plan their own GMIs; that the template is given keeps it out of what is said.
        config = PlanConfig(gpus=gpus, gmis_per_gpu=count, backend=wanted, template="tcg")
        return make_plan(config, ReduceConfig(), 1, machine, template="tcg")
    except ConfigError as error:
        said = str(error).replace("plan.gmis_per_gpu", "sweep.jobs_per_gpu")
        raise ConfigError(said.replace("plan.gpus", "sweep.gpus")) from None


class Places:
    """All places of a sweep, free and taken; see `places_of` for the plan."""

    def __init__(self, plan: Plan, machine: Machine) -> None:
        self._free = list(plan.slices)
        index_of = {gpu.uuid: gpu.index for gpu in machine.gpus}
        index_of |= {one.uuid: gpu.index for gpu in machine.gpus for one in gpu.instances}
        self._all: dict[int, list[Slice]] = {}
        self._labels: dict[int, str] = {}
        for share in plan.slices:
            here = self._all.setdefault(share.gpu, [])
            gpu = f"GPU {index_of[share.device]} " if share.device in index_of else ""
            self._labels[share.gmi] = f"{gpu}place {len(here)}"
            here.append(share)

    def has_room(self) -> bool:
        """Whether any place is free."""
        return bool(self._free)

    def take(self, num_gpus: int, *, alone: bool = False) -> Place | None:
        """A place on each of `num_gpus` GPUs, those with the most free ones; None: not now.

        With `alone` they are GPUs on which nobody else runs, now or until it is given back.
        """
        by_gpu: dict[int, list[Slice]] = {}
        for share in self._free:
            by_gpu.setdefault(share.gpu, []).append(share)
        if alone:
            by_gpu = {gpu: free for gpu, free in by_gpu.items() if free == self._all[gpu]}
        emptiest = sorted(by_gpu.values(), key=len, reverse=True)[:num_gpus]
        if len(emptiest) < num_gpus:
            return None
        taken = tuple(free[0] for free in emptiest)
        others = tuple(share for free in emptiest for share in free[1:]) if alone else ()
        self._free = [share for share in self._free if share not in (*taken, *others)]
        label = ", ".join(self._labels[share.gmi] for share in taken)
        return Place(taken, f"{label} alone" if alone else label, others)

    def give_back(self, place: Place) -> None:
        """The job that was there has ended."""
        free = [*self._free, *place.slices, *place.kept_free]
        self._free = sorted(free, key=lambda share: share.gmi)
