"""Packs: any commands, several at a time on every GPU."""

from __future__ import annotations

import itertools
import shlex
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self, cast

from rich.console import Console

from gmijax.config import ClusterConfig
from gmijax.config.pack import PackConfig
from gmijax.config.schema import from_dict, to_dict
from gmijax.control.console import Show, nearby
from gmijax.errors import ConfigError
from gmijax.packs.command_job import (
    CommandJob,
    absolute,
    jobs_of_file,
    require_programs,
    templates_of,
)
from gmijax.packs.command_kind import CommandKind, PackPaths
from gmijax.packs.progress import own_patterns
from gmijax.packs.slot_limiter import MOST_CLIENTS, SlotLimiter
from gmijax.packs.template import require_names
from gmijax.runs.folder import RUNS, RunPaths, given_run, read_json
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps.jobs_per_gpu import CORES_OF_A_JOB
from gmijax.sweeps.kind import Kind, Limiter
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.progress import State
from gmijax.sweeps.runner import SweepResult, run_work
from gmijax.sweeps.slots import Site, Slot, SlotPool, plan_slots
from gmijax.sweeps.space import MAX_JOBS, Choices, Interval, Space, corners, grid, require_few_jobs
from gmijax.sweeps.work import Folder, Work

_MOST_SHOWN = 4
"""Values of a name in an error."""


@dataclass(frozen=True)
class PackWork(Work[CommandJob]):
    """Commands; see `Work`.

    Attributes:
      limiters: what limits the slots of a run, once it has begun: the report, which is made
        before, lists their decisions. The only attribute that changes.
    """

    name = "pack"
    resume_requirement = "command and lists"
    limiters: list[SlotLimiter] = field(default_factory=list[SlotLimiter], compare=False)

    @property
    def ranking(self) -> PackConfig:
        """See `Work`."""
        return cast("PackConfig", self.settings)

    @property
    def stopping(self) -> str:
        """See `Work`."""
        # Whether a program saves then is its own affair.
        stop = f"running jobs get SIG{self.ranking.stop_signal} and may take"
        return f"{stop} {self.ranking.stop_timeout_s:g} s to end; a second {{}} ends them at once"

    @property
    def is_adaptive(self) -> bool:
        """See `Work`."""
        return self.ranking.jobs_per_gpu == "auto"

    @property
    def on_cpu(self) -> bool:
        """See `Work`."""
        return False

    @property
    def processes(self) -> int:
        """See `Work`."""
        return 1

    def paths(self, root: Path) -> PackPaths:
        """See `Work`."""
        return PackPaths(root, self.name)

    def paths_shown(self, number: int) -> Path:
        """The folder of a job, where it is not made yet."""
        root = given_run(*self.folder) or RUNS / f"{self.name}-DATE"
        return self.paths(root).run_dir(number)

    def sites(self, hosts: Sequence[Host]) -> list[Site]:
        """See `Work`."""
        sites = []
        for host in hosts:
            settings = replace(self.ranking, jobs_per_gpu=self._most(host))
            try:
                plan = plan_slots(settings, host.machine, {self.ranking.backend})
            except ConfigError as error:
                raise ConfigError(_with_own_backends(str(error))) from None
            sites.append(Site(plan, host.machine, host.name))
        return sites

    def _most(self, host: Host) -> int:
        """Slots on each GPU: all that may be used at once."""
        settings, cores = self.ranking, len(host.machine.cpu_cores)
        if settings.jobs_per_gpu != "auto":
            return settings.jobs_per_gpu
        if not host.machine.gpus:
            return max(1, cores // CORES_OF_A_JOB)
        gpus = settings.gpus or len(host.machine.gpus)
        num_gpus = len(gpus) if isinstance(gpus, tuple) else gpus
        num_jobs = settings.trials or len(self.jobs)
        return max(1, min(cores // num_gpus, -(-num_jobs // num_gpus), MOST_CLIENTS))

    def require_runnable(self, sites: Sequence[Site]) -> None:
        """See `Work`."""
        require_programs(self.jobs, self.ranking)

    def decided(
        self, hosts: Sequence[Host], console: Console, signals: StopSignals, scratch: Path | None
    ) -> Self:
        """See `Work`; the number at once is measured with the jobs themselves."""
        del hosts, console, signals, scratch
        return self

    def next_step(self, paths: SweepPaths, best: int) -> tuple[str, str]:
        """See `Work`."""
        return "read what the best job printed", f"less {shlex.quote(nearby(paths.log(best)))}"

    def kind(self, paths: SweepPaths, sites: Sequence[Site]) -> Kind[CommandJob]:
        """See `Work`."""
        cores = [
            len(site.machine.cpu_cores) // max(1, len({one.gpu for one in site.plan.allocations}))
            for site in sites
        ]
        most = [max(1, len(site.plan.allocations)) for site in sites]

        def at_once(slot: Slot) -> int:
            if self.limiters and slot.devices:
                return self.limiters[-1].at_once(slot)
            gpus = sites[slot.site].plan.layout.num_gpus
            return most[slot.site] // gpus if slot.devices else most[slot.site]

        names = [site.name for site in sites]
        return CommandKind(self.ranking, cast("PackPaths", paths), cores, names, at_once)

    def limiter(
        self, slots: SlotPool, sites: Sequence[Site], hosts: Sequence[Host], console: Console
    ) -> Limiter[CommandJob] | None:
        """See `Work`."""
        if not self.is_adaptive or not sites[0].machine.gpus:
            return None
        self.limiters.append(SlotLimiter(slots, sites, hosts, console))
        return self.limiters[-1]

    def warnings(self, sites: Sequence[Site]) -> Sequence[str]:
        """See `Work`."""
        if not (self.is_adaptive and sites[0].machine.gpus):
            return ()
        return (
            "pack.jobs_per_gpu=auto: on a GPU one job first, then more while they gain; at most "
            "one for each core",
        )

    @property
    def unranked(self) -> str:
        """See `Work`."""
        return (
            "no reward was found in the output: pack.metric says where it is, e.g. "
            "pack.metric='reward (-?[\\d.]+)', or pack.tag; steps by pack.steps='step (\\d+)'"
        )

    def state_of(self, run: RunPaths, job: CommandJob) -> State:
        """See `Work`."""
        if not run.summary.exists():
            return "waiting"
        try:
            status = read_json(run.summary).get("status")
        except ConfigError as error:  # The program may not be one that may run twice.
            raise ConfigError(f"{error}; remove it to run job {job.number} again") from None
        return "completed" if status == "completed" else "waiting"

    def described(self) -> dict[str, Any]:
        """See `Work`."""
        pack = to_dict(self.settings)
        pack["env"] = sorted(pack["env"])  # Names alone: values may be secret.
        decisions = self.limiters[-1].decisions if self.limiters else []
        commands = {shlex.join(job.command): None for job in self.jobs}
        return {"pack": pack, "commands": list(commands), "at_once": decisions}

    def identity(self) -> dict[str, Any]:
        """See `Work`."""
        commands = list(dict.fromkeys(job.command for job in self.jobs))
        return {"commands": [list(command) for command in commands], **self.grid_identity()}


def _shown(values: Choices | Interval) -> str:
    """Values of a name in an error, the first of many."""
    if isinstance(values, Interval):
        return f"interval({values.low:g},{values.high:g})"
    more = ",..." if len(values.values) > _MOST_SHOWN else ""
    return f"{','.join(values.values[:_MOST_SHOWN])}{more}"


def pack_of(
    settings: PackConfig,
    space: Space,
    command: Sequence[str],
    folder: Folder,
    cluster: ClusterConfig | None = None,
) -> PackWork:
    """The work of a pack.

    Args:
      settings: of the pack.
      space: values of the names that are placeholders in the command.
      command: arguments of the program; empty with `pack.commands`.
      folder: of the pack.
      cluster: the nodes that jobs run on.

    Raises:
      ConfigError: names and placeholders do not fit, or there is no command.
    """
    own_patterns(settings.rate, settings.steps, settings.metric)
    try:
        shlex.split(settings.resume or "")
    except ValueError as error:
        raise ConfigError(f"pack.resume={settings.resume}: {error}") from None
    if command:
        command = [absolute(command[0]), *command[1:]]

    def make_job(number: int, chosen: Mapping[str, str]) -> CommandJob:
        return CommandJob(number, dict(chosen), tuple(command), settings.total_steps)

    nodes = cluster or ClusterConfig()
    names = {name: _shown(values) for name, values in space.items()}
    lists = " ".join(f"{name}={values}" for name, values in names.items())
    if settings.commands is not None:
        if command or space:
            own = lists or "a command after --"
            raise ConfigError(f"pack.commands={settings.commands}: not with {own}")
        jobs = jobs_of_file(settings)
        return PackWork(settings, {}, make_job, jobs, nodes, folder)
    if not command:
        raise ConfigError("no command: expected gmijax pack [NAME=VALUE,VALUE ...] -- COMMAND ...")
    if settings.copies is not None and space:
        raise ConfigError(f"pack.copies={settings.copies}: not with {lists}; leave one out")
    require_names([*command, *templates_of(settings)], names)
    if empty := [key for key, values in space.items() if values == Choices(())]:
        raise ConfigError(f"{empty[0]}: an empty list")
    points = grid(space, "pack") if settings.sampler == "grid" else corners(space)
    if settings.copies is not None:
        require_few_jobs("pack.copies", settings.copies)
        points = [{}] * settings.copies
    jobs = tuple(make_job(number, point) for number, point in enumerate(points))
    return PackWork(settings, space, make_job, jobs, nodes, folder)


def pack(
    command: Sequence[str],
    grid: Mapping[str, Sequence[object]] | None = None,
    *,
    run_dir: str | None = None,
    show: Show = False,
    **settings: Any,
) -> SweepResult:
    """Runs a command with every combination of values, several at a time on every GPU.

    Examples:
      >>> pack(["python", "train.py", "--seed", "{seed}"], {"seed": range(4)}, jobs_per_gpu=2)

    Args:
      command: arguments of the program, with placeholders: names of the grid, `{job}` and
        `{run_dir}`. No shell reads it.
      grid: values of each name.
      run_dir: folder of the pack; None: `runs/pack-<date>-<time>`.
      show: print live progress and the ranking.
      settings: keys of `pack.*`.

    Raises:
      ConfigError, SweepFailed, JobInterrupted: as `run_work`.
    """
    command = _listed("command", command)
    if wrong := [word for word in command if not isinstance(word, str)]:
        raise ConfigError(f"command: {wrong[0]!r}: expected text")
    lists = {key: _listed(key, values, MAX_JOBS) for key, values in (grid or {}).items()}
    space = {key: Choices(tuple(map(str, values))) for key, values in lists.items()}
    own = from_dict(PackConfig, settings)
    return run_work(pack_of(own, space, command, Folder(run_dir, None)), show=show)


def _listed(key: str, values: Iterable[Any], most: int | None = None) -> tuple[Any, ...]:
    if isinstance(values, str | bytes | Mapping) or not isinstance(values, Iterable):
        raise ConfigError(f"{key}={values!r}: expected a list")
    # One more shows that there are too many, also of a generator without an end.
    found = tuple(values if most is None else itertools.islice(values, most + 1))
    if most is not None and len(found) > most:
        raise ConfigError(f"{key}: at most {most:,} values are allowed")
    return found


def _with_own_backends(error: str) -> str:
    """The error of a planner, without backends that `pack.backend` does not take."""
    cpu = "plan.backend=cpu (or CUDA_VISIBLE_DEVICES=-1)"
    error = error.replace(cpu, "CUDA_VISIBLE_DEVICES=-1")
    error = error.replace(" (any number is allowed with plan.backend=cpu)", "")
    error = error.replace("use plan.backend=mig, or choose", "choose")
    error, here, names = error.partition("; available here: ")
    own = typing.get_args(typing.get_type_hints(PackConfig)["backend"])
    kept = ", ".join(name for name in names.split(", ") if name in own)
    return f"{error}{here}{kept}".replace("plan.backend", "pack.backend")
