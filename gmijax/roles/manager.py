"""Which GMIs there are and where they live: plans, and the GMI manager (section 3, Listing 1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Iterable, Sequence
from typing import Any, Literal, TypeAlias

from gmijax.config import BackendName, PlanConfig, ReduceConfig
from gmijax.config.schema import from_dict
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import detect_machine
from gmijax.partition.layout import Layout
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.roles.group import Operation
from gmijax.roles.role import here

BackendChoice: TypeAlias = Literal["auto", BackendName]


def plan(
    gpus: int | Sequence[int] = 1,
    gmis_per_gpu: int = 1,
    *,
    layout: Sequence[Sequence[int]] | None = None,
    backend: BackendChoice = "auto",
    sm_percent: float | Sequence[float] | None = None,
    memory_fraction: float | Sequence[float] | None = None,
) -> Plan:
    """A plan for roles of one's own on this machine; see `gmijax.launch`.

    Args:
      gpus: number of GPUs, or their indices as nvidia-smi lists them. Without a GPU here they
        are virtual: groups of processes.
      gmis_per_gpu: GMIs on each of them.
      layout: ids of the GMIs of every GPU, e.g. `[[0, 1], [2]]`, instead of the two.
      backend: how a GMI gets its share; `auto` decides, `Plan.reasons` has the reason.
      sm_percent: cap on the SMs of every GMI in percent (mps), or one for each; None for no cap.
      memory_fraction: part of a GPU's memory for every GMI, or one for each; None: 0.8 split
        evenly.

    Raises:
      ConfigError: bad input, or this machine cannot do it.
    """
    given = {
        "gpus": gpus,
        "gmis_per_gpu": gmis_per_gpu,
        "layout": layout,
        "backend": backend,
        "sm_percent": sm_percent,
        "memory_fraction": memory_fraction,
    }
    # As from a command line: what is no number, or not among the allowed, is one line.
    wanted = from_dict(PlanConfig, {key: _plain(value) for key, value in given.items()}, "plan.")
    # A role's data are in host memory, so other strategies have nothing to offer.
    made = make_plan(wanted, ReduceConfig(strategy="mpr"), 0, detect_machine())
    # What the templates call roles are parts of reinforcement learning.
    reasons = tuple(why for why in made.reasons if not why.startswith(("template ", "intra ")))
    return dataclasses.replace(made, roles=(), intra="host", reasons=reasons)


def _plain(value: Any) -> Any:
    """Sequences of any kind as lists."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value


class GMIManager:
    """Registers GMIs, binds them to GPUs and groups them; in a GMI, talks to the others.

    Where the job is started it makes the plan. A role that keeps it uses the same object in its
    GMI for `allreduce`, `send` and `recv`.

    Args:
      num_gpus: GPUs of the job; virtual ones on the backend `cpu`.
      backend: how GMIs get their shares.
      sm_percent: cap on the SMs of every GMI in percent (mps); None for no cap.
      memory_fraction: part of a GPU's memory for every GMI; None for an even split.
    """

    def __init__(
        self,
        num_gpus: int = 1,
        backend: BackendChoice = "auto",
        *,
        sm_percent: float | Sequence[float] | None = None,
        memory_fraction: float | Sequence[float] | None = None,
    ) -> None:
        if num_gpus < 1:
            raise ConfigError(f"num_gpus={num_gpus}: must be at least 1")
        self.num_gpus = num_gpus
        self.backend: BackendChoice = backend
        self.sm_percent = sm_percent
        self.memory_fraction = memory_fraction
        self._gpu_of: dict[int, int | None] = {}
        self._groups: dict[Hashable, set[int]] = {}

    def add_gmi(self, gmi: int) -> GMIManager:
        """Registers a GMI; returns the manager itself, as in the paper's listing.

        Raises:
          ConfigError: not an id, or registered already.
        """
        if gmi < 0 or gmi in self._gpu_of:
            known = "registered already" if gmi in self._gpu_of else "must be at least 0"
            raise ConfigError(f"gmi={gmi}: {known}")
        self._gpu_of[gmi] = None
        return self

    def set_gpu(self, gmi: int, gpu: int) -> None:
        """Binds a registered GMI to the GPU at position `gpu`, 0 to `num_gpus - 1`.

        Raises:
          ConfigError: no such GMI or GPU.
        """
        self._check(gmi)
        if not 0 <= gpu < self.num_gpus:
            raise ConfigError(f"gpu={gpu}: there are GPUs 0 to {self.num_gpus - 1}")
        self._gpu_of[gmi] = gpu

    def get_group(self, gmi: int, name: Hashable) -> set[int]:
        """Takes a registered GMI into the group `name`; returns the ids of the whole group.

        Raises:
          ConfigError: no such GMI.
        """
        self._check(gmi)
        group = self._groups.setdefault(name, set())
        group.add(gmi)
        return group

    def layout(self) -> Layout:
        """Which GMI lives on which GPU.

        Raises:
          ConfigError: a GMI without a GPU, a GPU without a GMI, or a gap in the ids.
        """
        if homeless := [gmi for gmi, gpu in self._gpu_of.items() if gpu is None]:
            raise ConfigError(f"gmi={homeless[0]}: bound to no GPU; call set_gpu")
        return Layout(
            tuple(
                tuple(sorted(gmi for gmi, home in self._gpu_of.items() if home == gpu))
                for gpu in range(self.num_gpus)
            )
        )

    def plan(self) -> Plan:
        """The plan for this machine.

        Raises:
          ConfigError: see `layout`, or the machine cannot do it.
        """
        return plan(
            layout=self.layout().gmis_of_gpu,
            backend=self.backend,
            sm_percent=self.sm_percent,
            memory_fraction=self.memory_fraction,
        )

    def allreduce(
        self, data: Any, group: Iterable[int] | None = None, op: Operation = "mean"
    ) -> Any:
        """In a GMI: the mean or sum of `data` over `group`, see `Role.collective`."""
        return here("allreduce").reduce(data, op, group)

    def send(self, data: Any, dst: int) -> None:
        """In a GMI: sends `data` to GMI `dst` without waiting, see `Role.send`."""
        here("send").send(data, dst)

    def recv(self, src: int, timeout_s: float | None = None) -> Any:
        """In a GMI: waits for the next message of GMI `src`, see `Role.recv`."""
        return here("recv").recv(src, timeout_s)

    def _check(self, gmi: int) -> None:
        if gmi not in self._gpu_of:
            raise ConfigError(f"gmi={gmi}: not registered; registered are {sorted(self._gpu_of)}")
