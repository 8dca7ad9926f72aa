"""The run folder, the life of a job, and what is sent of it to Weights & Biases."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal

from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError

_MOST_TRACED: Final = 20


@dataclass(frozen=True, kw_only=True)
class Timeouts(KeyGroup):
    """How long a job waits for its GMIs."""

    prefix = "run."

    start_timeout_s: float = doc(
        "longest wait for a GMI to start and compile, seconds", positive=True
    )
    stall_timeout_s: float = doc(
        "a GMI with no progress for this long has failed, seconds", positive=True
    )
    stop_timeout_s: float = doc(
        "time GMIs get to finish their iteration or unroll and save when a signal such as SIGTERM "
        "asks the job to end, seconds; after Ctrl-C they get run.stall_timeout_s",
        positive=True,
    )
    grace_s: float = doc(
        "time a GMI gets to end by itself before it is killed, seconds", positive=True
    )


@dataclass(frozen=True, kw_only=True)
class RunConfig(Timeouts):
    """The run folder and the job's life."""

    dir: str | None = doc("run folder; null: runs/<env>-<algo>-<date>-<time>")
    name: str | None = doc(
        "name of the run folder below runs/ (ignored if run.dir is given)", may_be_empty=True
    )
    resume: str | None = doc(
        "continue from a run folder, from one of its checkpoints, or from `last`, in a new run "
        "folder; auto: continue in run.dir if it has a checkpoint, else start"
    )
    checkpoint_every: int = doc("iterations between checkpoints; 0: only at the end", low=0)
    keep_checkpoints: int | None = doc(
        "checkpoints that are kept: the last ones, among them always the one with the best "
        "return, in an evaluation if there are any; null: all",
        low=1,
    )
    max_restarts: int = doc(
        "how often a job whose GMIs were lost is started again from its last good checkpoint; a "
        "newer checkpoint resets the count; 0: never",
        low=0,
    )
    elastic: bool = doc("continue with the remaining GPUs where a restart finds fewer of them")
    measure_throughput: bool = doc(
        "after training, also measure simulation alone and simulation with inference"
    )
    profile: str | None = doc(
        "trace these iterations for a profile, e.g. 20:25 with both included, counted from 1 when "
        "the command starts (docs/speed.md); null: none",
        default=None,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dir is not None and "://" in self.dir:
            raise ConfigError(
                f"run.dir={self.dir}: expected the path of a folder; mount what is elsewhere"
            )
        if self.resume == "auto" and self.dir is None and self.name is None:
            raise ConfigError(
                "run.resume=auto: needs run.dir or run.name, the folder to continue in"
            )
        _ = self.profiled

    @property
    def profiled(self) -> tuple[int, int] | None:
        """The first and the last iteration of `profile`; raises ConfigError if it is none."""
        if self.profile is None:
            return None
        match = re.fullmatch(r"([1-9]\d{0,8}):([1-9]\d{0,8})", self.profile, re.ASCII)
        if match is None or int(match[1]) > int(match[2]):
            raise ConfigError(
                f"run.profile={self.profile}: expected FIRST:LAST, two iterations from 1 on, "
                "e.g. 20:25"
            )
        first, last = int(match[1]), int(match[2])
        if last - first >= _MOST_TRACED:
            raise ConfigError(
                f"run.profile={self.profile}: {last - first + 1} iterations; at most "
                f"{_MOST_TRACED}, because memory holds a trace until it is written"
            )
        return first, last


@dataclass(frozen=True, kw_only=True)
class WandbConfig(KeyGroup):
    """Metrics, configuration and summary at Weights & Biases."""

    prefix = "wandb."

    mode: Literal["off", "online", "offline"] = doc(
        "send metrics to Weights & Biases; offline: keep them in the run folder for `wandb sync`",
        default="off",
    )
    project: str = doc("project of the run in Weights & Biases", default="gmijax")
    group: str | None = doc(
        "group of the run in Weights & Biases; null: none, for jobs of a sweep the name of its "
        "folder",
        default=None,
    )
