"""Jobs of a pack for the scheduler: any commands."""

from __future__ import annotations

import math
import os
import shlex
import signal
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gmijax.clock import running_s
from gmijax.config.pack import PackConfig
from gmijax.packs.command_job import CommandJob
from gmijax.packs.event_files import EventReader
from gmijax.packs.failure import failure_of
from gmijax.packs.output import OutputReader
from gmijax.packs.progress import ProgressReader, own_patterns
from gmijax.packs.recorder import Recorder, mark_of
from gmijax.packs.template import fill
from gmijax.runs.folder import RunPaths, naming, write_json
from gmijax.sweeps.children import ChildStatus, Process
from gmijax.sweeps.kind import JobStart
from gmijax.sweeps.paths import ENV_PACK_DIR, SweepPaths
from gmijax.sweeps.running import JobOutcome, Running
from gmijax.sweeps.slots import Slot

_CLIENT_AFTER_S: Final = 30.0
"""When a job that reports nothing has taken its GPU."""

_SAME_FAULT_S: Final = 30.0
"""Jobs of a GPU that end within such a time of its fault were ended by the same one."""

_MAX_SHARED_FAULTS: Final = 2
"""A job that was ended by more faults of its GPU runs alone."""

_THREADS: Final = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Variables by which libraries choose the number of their threads: by default one a core."""

_GROWING: Final = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "TF_FORCE_GPU_ALLOW_GROWTH": "true"}
"""JAX and TensorFlow would take most of the GPU's memory at their start."""


class PackPaths(SweepPaths):
    """Files of a pack: those of a job apart from what the job itself writes."""

    def run_dir(self, number: int) -> Path:
        """The folder of a job for what it writes itself."""
        return super().job(number).root

    def job(self, number: int) -> RunPaths:
        """What the pack keeps of a job."""
        return RunPaths(self.run_dir(number) / "pack")

    def log(self, number: int) -> Path:
        """What a job prints."""
        return self.job(number).root / "output.log"


class CommandKind:
    """Any commands, each a process of its own.

    Args:
      settings: of the pack.
      paths: its files.
      cores: CPU cores that the jobs of a GPU share, by site.
      names: of the machines, by site; None: this one.
      at_once: number of jobs that share a GPU and the cores at a slot.
    """

    def __init__(
        self,
        settings: PackConfig,
        paths: PackPaths,
        cores: Sequence[int],
        names: Sequence[str | None],
        at_once: Callable[[Slot], int],
    ) -> None:
        self._settings, self._paths = settings, paths
        self._cores, self._names, self._at_once = cores, names, at_once
        self._own = own_patterns(settings.rate, settings.steps, settings.metric)
        self._attempts: dict[int, _Attempt] = {}
        self._from_nothing: set[int] = set()
        self._gpu_faults: Counter[int] = Counter()
        self._faulted_s: dict[tuple[int, int], float] = {}

    def together(
        self, job: CommandJob, queue: Sequence[CommandJob], alone: Collection[int]
    ) -> tuple[CommandJob, ...]:
        """See `Kind`."""
        del queue, alone
        return (job,)

    def start(self, jobs: tuple[CommandJob, ...], slot: Slot) -> JobStart:
        """See `Kind`."""
        (job,) = jobs
        number, settings = job.number, self._settings
        run, log = self._paths.job(number), self._paths.log(number)
        run_dir = self._paths.run_dir(number)
        run.root.mkdir(parents=True, exist_ok=True)
        # Before its first report it has saved nothing that it could continue from.
        may_resume = settings.resume is not None and run.metrics.exists()
        resumes = may_resume and number not in self._from_nothing
        if not resumes:
            self._from_nothing.discard(number)
            run.metrics.unlink(missing_ok=True)
        more = shlex.split(settings.resume or "") if resumes else []
        arguments = job.arguments(run_dir, more)
        with naming(log), log.open("a") as file:
            file.write(f"$ {shlex.join(arguments)}\n")
        at_once = 1 if slot.is_alone else self._at_once(slot)
        process = Process(
            f"job {run_dir.name}",
            arguments,
            log,
            self._variables(job, run_dir, self._cores[slot.site] // at_once),
            cwd=None if settings.cwd is None else job.folder(run_dir, settings.cwd),
            is_client=True,
            memory_fraction=None if at_once == 1 else 1.0 / at_once,
            stop_signal=signal.Signals[f"SIG{settings.stop_signal}"],
            lock=run.lock,
        )
        begins = log.stat().st_size
        self._attempts[number] = _Attempt(_Silence(log), begins, resumes)
        output = OutputReader(log, begins)
        events = None
        if settings.tag is not None:
            events = EventReader(run_dir, settings.tag, time.time())
        progress = ProgressReader(output, self._own, running_s(), events)
        # On CPU cores alone nothing is compiled that others could use.
        mark = mark_of(job, self._names[slot.site]) if slot.devices else None
        reader = Recorder(progress, run.metrics, mark)
        return JobStart(process, (reader,), is_awaited=mark is not None and not mark.exists())

    def _variables(self, job: CommandJob, run_dir: Path, cores: int) -> dict[str, str]:
        values = job.values(run_dir)
        threads = dict.fromkeys(_THREADS, str(max(1, cores)))
        defaults = {**threads, **_GROWING}
        for key in os.environ.keys() & defaults.keys():
            del defaults[key]
        given = {
            key: fill([str(text)], values)[0]
            for key, text in self._settings.env.items()
            if text is not None
        }
        return {
            **defaults,
            # Lines come when they are printed: a rate can be read, and a hang be seen.
            "PYTHONUNBUFFERED": "1",
            ENV_PACK_DIR: str(self._paths.root),
            "GMIJAX_JOB": values["job"],
            "GMIJAX_RUN_DIR": values["run_dir"],
            **given,
        }

    def require_ranked(self, line: Mapping[str, Any]) -> None:
        """See `Kind`."""
        del line  # A command may print it for the first time at its end.

    def why_hung(self, running: Running[CommandJob]) -> str | None:
        """See `Kind`."""
        (job,) = running.jobs
        attempt, limit_s = self._attempts[job.number], self._settings.stall_s
        silent_s = attempt.silence.seconds()
        self._look_at_client(running, job, attempt)
        if limit_s is None or silent_s <= limit_s:
            return None
        return f"printed nothing for {limit_s:g} s (pack.stall_s)"

    def _look_at_client(
        self, running: Running[CommandJob], job: CommandJob, attempt: _Attempt
    ) -> None:
        """Sets the job's note while its process is no MPS client."""
        is_due = job.progress.reports > 0 and attempt.client_asked_s is None
        latest_s = attempt.client_asked_s or running.started_s
        if attempt.is_client or not (is_due or running_s() - latest_s > _CLIENT_AFTER_S):
            return
        attempt.client_asked_s = running_s()
        if running.slot.backend == "mps":
            job.progress.note = running.host.why_no_client(running.child_id)
        attempt.is_client = job.progress.note is None

    def outcome(self, running: Running[CommandJob], job: CommandJob) -> JobOutcome:
        """See `Kind`."""
        seen = running.look() or ChildStatus(None)
        if running.hang_reason is not None:
            return JobOutcome(error=running.hang_reason, is_fault=True)
        # One that was asked may save and end as if it were complete.
        if running.ended_by_shutdown or running.is_asked:
            return JobOutcome(is_interrupted=True)
        if seen.exit_code is None:
            return JobOutcome(error=running.host.lost, is_fault=True)
        if seen.exit_code == 0:
            return JobOutcome()
        attempt = self._attempts[job.number]
        why = failure_of(seen.exit_code, self._paths.log(job.number), attempt.begins)
        is_shared = running.slot.backend in ("mps", "mig") and not running.slot.is_alone
        alone, again = why.is_out_of_memory, None
        if why.is_gpu_fault and is_shared:
            alone = self._is_suspect(running, job)
            again = None if alone else "beside others: the fault may be that of another one"
        elif attempt.resumes and not job.progress.reports and not alone:
            # It had saved nothing yet: there is nothing to continue from.
            self._from_nothing.add(job.number)
            again = "from its beginning"
        return JobOutcome(
            error=why.error,
            is_fault=True,
            may_be_neighbours=alone,
            again=again,
            is_out_of_memory=why.is_out_of_memory,
        )

    def _is_suspect(self, running: Running[CommandJob], job: CommandJob) -> bool:
        """Whether a job may have caused the fault of its GPU that ended it.

        CUDA reports a fault to all clients, and not whose it was: the first to end is a
        suspect, and so is a job that was there at more than `_MAX_SHARED_FAULTS` faults.
        """
        gpu, now_s = (running.slot.site, running.slot.allocations[0].gpu), running_s()
        is_first = now_s - self._faulted_s.get(gpu, -math.inf) > _SAME_FAULT_S
        if is_first:
            self._faulted_s[gpu] = now_s
        self._gpu_faults[job.number] += 1
        return is_first or self._gpu_faults[job.number] > _MAX_SHARED_FAULTS

    def max_restarts(self, job: CommandJob) -> int:
        """See `Kind`."""
        del job
        return self._settings.max_restarts

    def stop_s(self, job: CommandJob, *, is_urgent: bool) -> float:
        """See `Kind`."""
        del job, is_urgent  # Whether a command hangs is not known.
        return self._settings.stop_timeout_s

    def ended(self, job: CommandJob, run: RunPaths) -> None:
        """See `Kind`."""
        progress = job.progress
        found = {"status": progress.state, "exit_code": progress.exit_code}
        more = {
            "wall_s": progress.wall_s,
            "env_steps": progress.env_steps,
            "env_steps_per_s": progress.mean_steps_per_s,
        }
        write_json(run.summary, {**found, **more, "error": progress.error})


@dataclass
class _Attempt:
    """A start of a job.

    Attributes:
      silence: of its log.
      begins: byte of its log where what it prints begins.
      resumes: whether it was asked to continue from a checkpoint of its own.
      is_client: whether it was seen to have its share of the GPU.
      client_asked_s: when that was asked; None: not yet.
    """

    silence: _Silence
    begins: int
    resumes: bool
    is_client: bool = False
    client_asked_s: float | None = None


@dataclass
class _Silence:
    """How long a log has not grown."""

    log: Path
    size: int = -1
    since_s: float = 0.0

    def seconds(self) -> float:
        """Since the last look that saw it grow."""
        now_s, size = running_s(), 0
        with suppress(OSError):
            size = self.log.stat().st_size
        if size != self.size:
            self.size, self.since_s = size, now_s
        return now_s - self.since_s
