"""The run folder and the life of a job."""

from __future__ import annotations

from dataclasses import dataclass

from gmijax.schema import doc, require_at_least, require_positive


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """The run folder and the job's life."""

    dir: str | None = doc("run folder; null: runs/<env>-<algo>-<date>-<time>")
    name: str | None = doc("name of the run folder below runs/ (ignored if run.dir is given)")
    resume: str | None = doc(
        "continue from a run folder, from one of its checkpoints, or from `last`"
    )
    checkpoint_every: int = doc("iterations between checkpoints; 0: only at the end")
    measure_throughput: bool = doc(
        "after training, also measure simulation alone and simulation with inference"
    )
    start_timeout_s: float = doc("longest wait for a GMI to start and compile, seconds")
    stall_timeout_s: float = doc("a GMI with no progress for this long has failed, seconds")
    grace_s: float = doc("time a GMI gets to end by itself before it is killed, seconds")

    def __post_init__(self) -> None:
        require_at_least("run.checkpoint_every", self.checkpoint_every, 0)
        for key in ("start_timeout_s", "stall_timeout_s", "grace_s"):
            require_positive(f"run.{key}", getattr(self, key))
