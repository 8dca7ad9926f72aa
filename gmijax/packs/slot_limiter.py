"""`pack.jobs_per_gpu=auto`: how many commands run at once on each GPU, found while they run."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Final

from rich.console import Console

from gmijax.clock import running_s
from gmijax.machine.nvidia import GpuLoad
from gmijax.packs.command_job import CommandJob
from gmijax.sweeps.density import ConcurrencySearch, Decision, JobProgress
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.running import Running
from gmijax.sweeps.slots import Site, Slot, SlotPool

MOST_CLIENTS: Final = 48
"""Contexts of an MPS daemon on one GPU before driver 590
(https://docs.nvidia.com/deploy/mps/, "Client contexts")."""

_LOOK_S: Final = 1.0
_ROOM: Final = 0.95
"""Part of a GPU's memory that jobs may have."""

_MEMORY_MARGIN: Final = 1.15
"""Safety factor on the largest memory that a job has used so far."""

_SILENT_S: Final = 180.0
"""How long a first job may run without a report until it counts as one that makes none."""

_IDLE: Final = 0.6
"""A GPU that is busy less often can take a second job that reports nothing."""


class SlotLimiter:
    """Limits the slots of each GPU to what its rule decides.

    Attributes:
      decisions: all changes so far, as the report has them.

    Args:
      slots: of the jobs.
      sites: machines, in the order of `slots`.
      hosts: the same.
      console: where changes are printed.
    """

    def __init__(
        self, slots: SlotPool, sites: Sequence[Site], hosts: Sequence[Host], console: Console
    ) -> None:
        self._slots, self._hosts, self._console = slots, hosts, console
        self._looked_s = self._began_s = running_s()
        self._gpus: dict[tuple[int, int], _Gpu] = {}
        self.decisions: list[dict[str, Any]] = []
        for number, (site, host) in enumerate(zip(sites, hosts, strict=True)):
            titles = {gpu.uuid: f"GPU {gpu.index}" for gpu in site.machine.gpus}
            node = f"{site.name} " if site.name else ""
            by_gpu: dict[int, list[str]] = defaultdict(list)
            for allocation in site.plan.allocations:
                by_gpu[allocation.gpu].append(allocation.device)
            for gpu, devices in by_gpu.items():
                device = devices[0]
                title = f"{node}{titles.get(device, device)}"
                self._gpus[number, gpu] = _Gpu(device, title, len(devices), host)
                slots.limit(number, gpu, 1)

    def at_once(self, slot: Slot) -> int:
        """Jobs that are to share the GPU of a slot."""
        return self._gpus[slot.site, slot.allocations[0].gpu].rule.target

    def look(self, running: Sequence[Running[CommandJob]]) -> list[Running[CommandJob]]:
        """See `Limiter`."""
        now_s = running_s()
        if now_s - self._looked_s < _LOOK_S:
            return []
        self._looked_s = now_s
        ended: list[Running[CommandJob]] = []
        for key, gpu in self._gpus.items():
            here = [one for one in running if (one.slot.site, one.slot.allocations[0].gpu) == key]
            if here and not any(one.is_asked for one in here):
                ended += self._apply(key, gpu.look(now_s, here), here)
        return ended

    def forbid(self, running: Running[CommandJob], why: str) -> bool:
        """See `Limiter`."""
        key = running.slot.site, running.slot.allocations[0].gpu
        gpu = self._gpus[key]
        decision = gpu.rule.forbid(gpu.rule.target, why)
        self._apply(key, decision, [])
        return decision is not None

    def _apply(
        self,
        key: tuple[int, int],
        decision: Decision | None,
        here: Sequence[Running[CommandJob]],
    ) -> list[Running[CommandJob]]:
        if decision is None:
            return []
        gpu = self._gpus[key]
        self._slots.limit(*key, decision.target)
        gpu.since_s = running_s()
        self._console.print(f"  {gpu.title}: {decision.target} at once; {decision.why}")
        measured = {str(count): found.per_s for count, found in gpu.rule.measured.items()}
        self.decisions.append(
            {
                "time_s": round(running_s() - self._began_s, 1),
                "gpu": gpu.title,
                "at_once": decision.target,
                "rate_per_s": measured,
                "why": decision.why,
            }
        )
        newest = sorted(here, key=lambda one: one.started_s, reverse=True)
        return newest[: max(0, len(here) - decision.target)]


class _Gpu:
    """One GPU: its rule, and the memory that its jobs take."""

    def __init__(self, device: str, title: str, slots: int, host: Host) -> None:
        self.device, self.title, self._host = device, title, host
        self.since_s = 0.0
        self._slots = slots
        self.rule = ConcurrencySearch(slots)
        self._measured: set[tuple[str, ...]] = set()
        found = host.load_of(device)
        self._before_mib = found.used_mib if found else 0.0
        self._peak_mib = 0.0
        self._busy: list[float] = []
        self._has_doubled = False
        self._latest: Sequence[Running[CommandJob]] = ()
        self._are_known: bool | None = None

    def look(self, now_s: float, here: Sequence[Running[CommandJob]]) -> Decision | None:
        """What to change."""
        before, self._latest = self._latest, here
        self._begin_anew(here)
        load = self._host.load_of(self.device)
        if load is not None:
            self._busy = [*self._busy[-29:], load.busy]
            if decision := self._by_memory(load, len(here)):
                return decision
        # Those that ran from start to end beside so many: a rate can never be measured.
        are_short = any(
            one.jobs[0].progress.state == "completed" and one.started_s >= self.since_s
            for one in before
        )
        if are_short and (decision := self.rule.ended_early()):
            return decision
        reports = [one.jobs[0].progress.reports for one in here]
        if not any(reports) and now_s - min(one.started_s for one in here) > _SILENT_S:
            return self._without_rate()
        are_known = all(one.jobs[0].num_timesteps for one in here)
        if any(reports) and are_known != self._are_known:
            self._are_known = are_known
            self.rule.forget()
        return self.rule.look(now_s, _seen(here, are_known))

    def _begin_anew(self, here: Sequence[Running[CommandJob]]) -> None:
        """Measures again from the number now, once only jobs of other commands run."""
        commands = {one.jobs[0].command for one in here}
        if not self.rule.is_settled:
            self._measured |= commands
        elif self._measured and self._measured.isdisjoint(commands):
            self.rule = ConcurrencySearch(self._slots, self.rule.target)
            self._measured, self._peak_mib, self._has_doubled = commands, 0.0, False

    def _by_memory(self, load: GpuLoad, count: int) -> Decision | None:
        each_mib = max(0.0, load.used_mib - self._before_mib) / count
        self._peak_mib = max(self._peak_mib, each_mib)
        if not self._peak_mib:
            return None
        room_mib = _ROOM * (load.total_mib - self._before_mib)
        most = int(room_mib / (_MEMORY_MARGIN * self._peak_mib))
        if most >= self.rule.most:
            return None
        why = f"each takes {self._peak_mib:,.0f} of {room_mib:,.0f} MiB"
        return self.rule.forbid(most + 1, why)

    def _without_rate(self) -> Decision | None:
        """Nothing is reported: two at once if one leaves the GPU idle."""
        if self._has_doubled or self.rule.most < 2:
            return None
        self._has_doubled = True
        busy = statistics.fmean(self._busy) if self._busy else 1.0
        seen = f"no rate is found (pack.rate, pack.steps); the GPU is busy {busy:.0%} of the time"
        return self.rule.assume(2 if busy < _IDLE else 1, seen)


def _seen(here: Sequence[Running[CommandJob]], are_known: bool) -> dict[int, JobProgress]:
    """Part of the whole that each has done, where that is known of all; else steps."""
    return {
        job.number: JobProgress(
            job.progress.env_steps / ((job.num_timesteps or 1) if are_known else 1),
            job.progress.reports,
        )
        for job in (one.jobs[0] for one in here)
    }
