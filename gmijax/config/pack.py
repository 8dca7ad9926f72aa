"""All keys of `python -m gmijax.pack`, beside the command that it runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from gmijax.config.schema import doc
from gmijax.config.sweep import JobsConfig
from gmijax.errors import ConfigError

METRIC: Final = "metric"
"""Key of what jobs are compared by, in lines of metrics."""


@dataclass(frozen=True, kw_only=True)
class PackConfig(JobsConfig):
    """How commands share the GPUs, what is read from them, and how they are ended."""

    prefix = "pack."

    copies: int | None = doc(
        "how often a command without a grid is run, e.g. an agent of a sweep", default=None, low=1
    )
    commands: str | None = doc(
        "file with a command in every line, instead of one after --; - is the standard input",
        default=None,
    )
    backend: Literal["auto", "mps", "share"] = doc(
        "how jobs share a GPU: under an MPS daemon (mps), by taking turns (share); auto: mps "
        "where it can be had",
        default="auto",
    )
    cwd: str | None = doc(
        "working folder of the jobs, may hold placeholders; null: that of gmijax pack",
        default=None,
    )
    env: Mapping[str, str | int | float | bool | None] = field(
        default_factory=dict,
        metadata={"doc": "environment variables of the jobs, may hold placeholders"},
    )
    steps: str | None = doc(
        "regular expression with one group, for the steps so far in a line of output; null: those "
        "of well-known trainers",
        default=None,
    )
    rate: str | None = doc(
        "regular expression with one group, for the steps per second, where no line has steps",
        default=None,
    )
    metric: str | None = doc(
        "regular expression with one group, for what jobs are ranked by; null: the reward that "
        "well-known trainers print",
        default=None,
    )
    tag: str | None = doc(
        "TensorBoard tag of what jobs are ranked by, instead of a metric; read from event files "
        "below the job's {run_dir}",
        default=None,
    )
    total_steps: int | None = doc(
        "steps of a job at its end, where its output does not have them; for ETA and pruner",
        default=None,
        low=1,
    )
    stall_s: float | None = doc(
        "a job that prints nothing for so long is ended, seconds; null: never",
        default=None,
        positive=True,
    )
    max_restarts: int = doc("how often a job that failed is started again", default=0, low=0)
    resume: str | None = doc(
        "arguments that are added to the command when a job is started again, may hold "
        "placeholders; null: none, it starts from its beginning",
        default=None,
    )
    stop_signal: Literal["TERM", "INT", "USR1", "HUP"] = doc(
        "signal that asks a job to save and end", default="TERM"
    )
    stop_timeout_s: float = doc(
        "time a job gets to end after that signal, seconds", default=25.0, positive=True
    )

    @property
    def objective(self) -> str:
        """Key of what jobs are ranked by, in their lines of metrics."""
        return METRIC

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.copies is not None and self.commands is not None:
            raise ConfigError("pack.copies, pack.commands: give one of them")
        if self.metric is not None and self.tag is not None:
            raise ConfigError("pack.metric, pack.tag: give one of them")
