"""What to run in the GMIs of a plan, and the start of one of them on this machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from gmijax.config import Timeouts
from gmijax.machine.interpreter import command
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.runs.cache import compilation_cache_dir
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends.backend import Backend
from gmijax.supervise.environment import COMPILATION_CACHE, gmi_environment
from gmijax.supervise.gmi_process import GmiProcess
from gmijax.supervise.job_kinds import JobKind
from gmijax.supervise.watched_gmi import GmiStatus, WatchedGmi


@dataclass(frozen=True, kw_only=True)
class Launch:
    """What to run in the GMIs of a plan.

    Attributes:
      plan: where GMIs live and what they share.
      machine: where this is; see `detect_machine`.
      run: the run folder; what the GMIs read from it is there already.
      kind: what the GMIs run, and what they share beside the block that reducers use.
      timeouts: time limits.
      stops_gracefully: the first signal of `STOP_SIGNALS` asks the GMIs to finish by themselves;
        otherwise signals do what Python does with them.
      waits_after_ctrl_c: a first Ctrl-C lets the GMIs finish as long as none of them has stalled
        (`timeouts.stall_timeout_s`), other signals for `timeouts.stop_timeout_s`; otherwise all
        signals do the latter.
      variables: more environment variables of every GMI.
      on_warning: called with a sentence when the job runs otherwise than planned.
      is_enough: true once the job has what it needs: the GMIs then finish as after a first signal;
        None: it ends by itself.
    """

    plan: Plan
    machine: Machine
    run: RunPaths
    kind: JobKind
    timeouts: Timeouts
    stops_gracefully: bool = True
    waits_after_ctrl_c: bool = False
    variables: Mapping[str, str] = field(default_factory=dict)
    on_warning: Callable[[str], None] = lambda _: None
    is_enough: Callable[[tuple[GmiStatus, ...]], bool] | None = None


def program_cache() -> Path:
    """Where GMIs that this process starts keep the programs that they compile."""
    return Path(os.environ.get(COMPILATION_CACHE) or compilation_cache_dir())


def environment_of(launch: Launch, gmi: int, added: Mapping[str, str]) -> dict[str, str]:
    """All environment variables of a GMI; `added` are those of its backend."""
    own, cache = dict(os.environ), compilation_cache_dir()
    variables = gmi_environment(launch.plan, gmi, own, cache, added)
    return {**variables, **launch.variables}


StartGmi = Callable[[int], WatchedGmi]


def start_gmi(
    launch: Launch, backend: Backend, inherited_fds: Mapping[str, int], gmi: int
) -> GmiProcess:
    """Starts a GMI on this machine; see `GmiProcess`."""
    return GmiProcess(
        gmi,
        command(launch.kind.module),
        environment_of(launch, gmi, backend.environment(gmi)),
        launch.run,
        inherited_fds,
    )
