"""The run folder and the life of a job."""

from __future__ import annotations

from dataclasses import dataclass

from gmijax.errors import ConfigError
from gmijax.schema import doc, require_at_least, require_positive


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """The run folder and the job's life."""

    dir: str | None = doc("run folder; null: runs/<env>-<algo>-<date>-<time>")
    name: str | None = doc("name of the run folder below runs/ (ignored if run.dir is given)")
    resume: str | None = doc(
        "continue from a run folder, from one of its checkpoints, or from `last`, in a new run "
        "folder; auto: go on in run.dir if there is a checkpoint, else start"
    )
    checkpoint_every: int = doc("iterations between checkpoints; 0: only at the end")
    keep_checkpoints: int | None = doc(
        "checkpoints that are kept: the last ones, among them always the one with the best "
        "return; null: all"
    )
    max_restarts: int = doc(
        "how often a job whose GMIs were lost is started again from its last good checkpoint; a "
        "newer checkpoint sets the count back; 0: never"
    )
    elastic: bool = doc("go on with the GPUs that are left where a restart finds fewer of them")
    measure_throughput: bool = doc(
        "after training, also measure simulation alone and simulation with inference"
    )
    start_timeout_s: float = doc("longest wait for a GMI to start and compile, seconds")
    stall_timeout_s: float = doc("a GMI with no progress for this long has failed, seconds")
    stop_timeout_s: float = doc(
        "time GMIs get to finish their iteration and save when the job is told to end, seconds"
    )
    grace_s: float = doc("time a GMI gets to end by itself before it is killed, seconds")

    def __post_init__(self) -> None:
        require_at_least("run.checkpoint_every", self.checkpoint_every, 0)
        require_at_least("run.max_restarts", self.max_restarts, 0)
        if self.keep_checkpoints is not None:
            require_at_least("run.keep_checkpoints", self.keep_checkpoints, 1)
        if self.resume == "auto" and self.dir is None and self.name is None:
            raise ConfigError("run.resume=auto: needs run.dir or run.name, the folder to go on in")
        for key in ("start_timeout_s", "stall_timeout_s", "stop_timeout_s", "grace_s"):
            require_positive(f"run.{key}", getattr(self, key))
