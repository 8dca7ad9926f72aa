"""What a command that runs many jobs brings: a sweep its trainings, a pack its commands."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, Self

from rich.console import Console

from gmijax.config import ClusterConfig
from gmijax.config.sweep import JobsConfig, Ranking
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps.any_job import J
from gmijax.sweeps.kind import Kind, Limiter
from gmijax.sweeps.nodes import Host
from gmijax.sweeps.paths import SweepPaths
from gmijax.sweeps.progress import State
from gmijax.sweeps.slots import Site, SlotPool
from gmijax.sweeps.space import Space
from gmijax.sweeps.study import MakeJob


class Folder(NamedTuple):
    """The folder of a command as the user names it: `run.dir`, `run.name`."""

    dir: str | None
    name: str | None


@dataclass(frozen=True)
class Work(ABC, Generic[J]):
    """Jobs, and how they are run; subclasses know their kind.

    Attributes:
      settings: how jobs share the GPUs, and where they come from.
      space: what the keys of jobs may be.
      make_job: a job with values of the space.
      jobs: all of a grid; of another sampler some that stand for all, to be checked.
      cluster: the nodes that they run on; without an engine it is this machine.
      folder: of the command.
      words: the command line without its folder, empty where there is none.

    Raises:
      ConfigError: a sampler has nothing to draw from.
    """

    settings: JobsConfig
    space: Space
    make_job: MakeJob[J]
    jobs: tuple[J, ...]
    cluster: ClusterConfig
    folder: Folder
    words: tuple[str, ...] = ()

    name: ClassVar[str]
    """Of the command, and of its report."""

    resume_requirement: ClassVar[str]
    """In words, what must be the same where a command continues."""

    def __post_init__(self) -> None:
        key, sampler = f"{self.settings.prefix}sampler", self.settings.sampler
        if sampler != "grid" and not self.space:
            raise ConfigError(
                f"{key}={sampler}: there is no list or interval to draw from; allowed: grid"
            )

    @property
    @abstractmethod
    def ranking(self) -> Ranking:
        """What jobs are compared by."""

    @property
    @abstractmethod
    def stopping(self) -> str:
        """What becomes of running jobs once a signal has come, whose name stands for `{}`."""

    @property
    def is_adaptive(self) -> bool:
        """Whether the number at once changes while jobs run."""
        return False

    @property
    @abstractmethod
    def on_cpu(self) -> bool:
        """Whether no job wants a GPU."""

    @property
    @abstractmethod
    def processes(self) -> int:
        """Most processes that a job runs at each of its slots."""

    @abstractmethod
    def paths(self, root: Path) -> SweepPaths:
        """Files in its folder."""

    @abstractmethod
    def sites(self, hosts: Sequence[Host]) -> list[Site]:
        """Slots for the jobs.

        Raises:
          ConfigError: there are no such GPUs, or the machine cannot run so many jobs.
        """

    @abstractmethod
    def require_runnable(self, sites: Sequence[Site]) -> None:
        """Refuses what can be seen before anything is started.

        Raises:
          ConfigError: names the key.
        """

    @abstractmethod
    def decided(
        self, hosts: Sequence[Host], console: Console, signals: StopSignals, scratch: Path | None
    ) -> Self:
        """The same with everything decided that has to be measured first; the GPUs are held."""

    @abstractmethod
    def next_step(self, paths: SweepPaths, best: int) -> tuple[str, str]:
        """What to type after it, and what for; `best` is the number of the best job."""

    @abstractmethod
    def kind(self, paths: SweepPaths, sites: Sequence[Site]) -> Kind[J]:
        """What the scheduler asks."""

    def limiter(
        self, slots: SlotPool, sites: Sequence[Site], hosts: Sequence[Host], console: Console
    ) -> Limiter[J] | None:
        """What changes the number of jobs at once; None: nothing does."""
        del slots, sites, hosts, console
        return None

    @property
    @abstractmethod
    def unranked(self) -> str:
        """Why there is no ranking where jobs are complete, for the user."""

    @abstractmethod
    def state_of(self, run: RunPaths, job: J) -> State:
        """Whether an earlier command has completed a job."""

    @abstractmethod
    def described(self) -> dict[str, Any]:
        """Its settings, and what else its report has."""

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """What must be the same where a command continues."""

    def warnings(self, sites: Sequence[Site]) -> Sequence[str]:
        """What is printed before the first job."""
        return ()

    def hint(self, report: Mapping[str, Any]) -> str:
        """A line once jobs are complete of which none can be ranked; else nothing."""
        is_any_complete = any(job["state"] == "completed" for job in report["jobs"])
        return self.unranked if is_any_complete and not report["ranking"] else ""

    def grid_identity(self) -> dict[str, Any]:
        """What must be the same of the jobs' values."""
        if self.settings.sampler == "grid":
            return {"jobs": [dict(job.overrides) for job in self.jobs]}
        sampler = {"sampler": self.settings.sampler, "seed": self.settings.seed}
        return sampler | {"space": {key: list(values) for key, values in self.space.items()}}


def name_of_request(held: Mapping[str, Any]) -> str | None:
    """The command whose `Work.identity` a folder holds; None: it is not one."""
    commands = held.get("commands", [])
    if not isinstance(commands, list) or not isinstance(held.get("jobs", []), list):
        return None
    if not held.keys() & {"jobs", "sampler"}:
        return None
    return "pack" if "commands" in held else "sweep"
