"""Jobs of a sweep for the scheduler: controllers of training runs."""

from __future__ import annotations

import math
import signal
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final

from gmijax.config.schema import to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.control.exit_codes import EXIT_BAD_INPUT, EXIT_INTERRUPTED
from gmijax.machine.interpreter import command
from gmijax.runs.folder import RunPaths
from gmijax.runs.history import MetricsReader
from gmijax.supervise.failures import may_be_neighbours, signal_name
from gmijax.sweeps.children import ChildStatus, Process
from gmijax.sweeps.hparams import write_hparams
from gmijax.sweeps.jobs import Job, placed
from gmijax.sweeps.kind import JobStart
from gmijax.sweeps.objective import require_logged
from gmijax.sweeps.packs import PackPlanner, own_end
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.running import JobOutcome, Running
from gmijax.sweeps.slots import Slot

MODULE: Final = "gmijax.workers.training_job"

_KILL_AFTER_S: Final = 15.0
"""Beyond what a job gives its GMIs to save and end."""

_ENDS_IF_ASKED: Final = (EXIT_INTERRUPTED, -signal.SIGINT, -signal.SIGTERM)
"""A controller that still starts, or that ends, does not handle the signal itself."""

_ENDED_BY_GPU: Final = ("mps", "mig")
"""Backends where a fault of one job can end another."""


class TrainingKind:
    """Training runs of gmijax.

    Args:
      settings: of the sweep.
      paths: its files.
    """

    def __init__(self, settings: SweepConfig, paths: SweepPaths) -> None:
        self._settings, self._paths = settings, paths
        self._packer = PackPlanner(settings, paths)

    def together(self, job: Job, queue: Sequence[Job], alone: Collection[int]) -> tuple[Job, ...]:
        """See `Kind`."""
        return self._packer.together(job, queue, alone)

    def start(self, jobs: tuple[Job, ...], slot: Slot) -> JobStart:
        """See `Kind`."""
        # Alone on a GPU a job does as it would without a sweep.
        backend = "auto" if slot.is_whole_gpu else slot.backend
        first, runs = jobs[0], [self._paths.job(job.number) for job in jobs]
        configs = [
            to_dict(placed(job, run, slot, backend)) for job, run in zip(jobs, runs, strict=True)
        ]
        order = self._paths.order(first.number)
        process = Process(
            f"job {order.stem}",
            tuple(command(MODULE, str(order))),
            self._paths.log(first.number),
            input_file=(order, {"configs": configs, "cpus": list(slot.cpus)}),
            has_lifeline=True,
        )
        readers = tuple(MetricsReader(run.metrics) for run in runs)
        for reader in readers:
            reader.new()  # Those are an earlier attempt's.
        return JobStart(process, readers)

    def require_ranked(self, line: Mapping[str, Any]) -> None:
        """See `Kind`."""
        require_logged(line, self._settings.objective)

    def why_hung(self, running: Running[Job]) -> str | None:
        """See `Kind`; a controller sees for itself whether its GMIs hang."""
        del running
        return None

    def outcome(self, running: Running[Job], job: Job) -> JobOutcome:
        """See `Kind`."""
        self._packer.forget(job)
        seen, are_several = running.look() or ChildStatus(None), len(running.jobs) > 1
        own = own_end(job, self._paths.job(job.number)) if are_several else None
        if own is not None:
            return self._failed(running, job, own.error) if own.error else JobOutcome()
        if seen.exit_code == 0 and not are_several:
            return JobOutcome()
        was_asked = running.is_asked and seen.exit_code in _ENDS_IF_ASKED
        if running.ended_by_shutdown or was_asked or (running.kill_sent and running.is_asked):
            return JobOutcome(is_interrupted=True)
        if seen.exit_code is None:
            return JobOutcome(error=running.host.lost, is_fault=True)
        if seen.exit_code == EXIT_INTERRUPTED:
            return JobOutcome(error="a signal from elsewhere interrupted it", is_fault=True)
        if seen.exit_code < 0:
            killed_by = signal_name(-seen.exit_code)
            error = f"its controller was killed by {killed_by}"
            return self._failed(running, job, error, is_fault=True)
        error = seen.last_line.removeprefix("gmijax.train: ") or f"exit code {seen.exit_code}"
        is_fault = are_several and seen.exit_code != EXIT_BAD_INPUT
        return self._failed(running, job, error, is_fault=is_fault)

    def _failed(
        self, running: Running[Job], job: Job, error: str, *, is_fault: bool = False
    ) -> JobOutcome:
        others = running.slot.backend in _ENDED_BY_GPU and may_be_neighbours(error)
        again = others and self.max_restarts(job) > 0
        return JobOutcome(error=error, is_fault=is_fault, may_be_neighbours=again)

    def max_restarts(self, job: Job) -> int:
        """See `Kind`."""
        return job.config.run.max_restarts

    def stop_s(self, job: Job, *, is_urgent: bool) -> float:
        """See `Kind`."""
        run = job.config.run
        if not is_urgent:
            return math.inf  # Its controller sees whether a GMI hangs.
        return run.stop_timeout_s + run.grace_s + _KILL_AFTER_S

    def ended(self, job: Job, run: RunPaths) -> None:
        """See `Kind`."""
        write_hparams(job, run, self._settings.objective)
