"""The outcome of a training job as its leader leaves it in `result.json`."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths, read_json


def summary_of(run: RunPaths) -> dict[str, Any]:
    """The summary of a job; empty where there is none, or a damaged one.

    No job continues from it, and each writes its own, so a damaged one does no harm.
    """
    with suppress(ConfigError):
        return read_json(run.summary)
    return {}


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """Outcome of a training job; rates are of all GMIs together.

    Attributes:
      status: `completed` or `stopped`.
      env_steps: learnt from, those before a resume too.
      iterations: of this start; with `algo=a3c` updates.
      train_wall_s: seconds of training, without evaluations.
      compile_s: seconds of making programs, without waiting for another GMI that makes the same.
      env_steps_per_s: the mean rate.
      step_per_s_train: the median rate of iterations, None where there was none.
      final_return: mean return of the latest episodes, None where none has ended.
      overflow_steps: environment steps for which a buffer of the simulator was too small, by
        buffer.
      checkpoint: folder of the last one, None where there is none.
      device: see `gmijax.devices.describe_device`.
      start_s: seconds of the parts of the start, by name.
      profile: see `IterationTrace.outcome`; None where nothing was asked for.
      step_per_s_sim, step_per_s_inference: rates without learning, and without a policy; None
        where they were not measured.
      pps, ttop, staleness, bytes_per_s: see `gmijax.a3c.report`; of asynchronous training.
      strategy, intra, inter: the exchange that was used, where it may differ from the plan's.
    """

    status: str
    env_steps: int
    iterations: int
    train_wall_s: float
    compile_s: float
    env_steps_per_s: float
    step_per_s_train: float | None
    final_return: float | None
    overflow_steps: Mapping[str, float]
    checkpoint: str | None
    device: Mapping[str, Any] = field(default_factory=dict)
    start_s: Mapping[str, float | None] | None = None
    profile: Mapping[str, Any] | None = None
    step_per_s_sim: float | None = None
    step_per_s_inference: float | None = None
    pps: float | None = None
    ttop: float | None = None
    staleness: Mapping[str, float] | None = None
    bytes_per_s: float | None = None
    strategy: str | None = None
    intra: str | None = None
    inter: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """The content of `result.json`; what may be missing and is None is left out."""
        values = {one.name: (getattr(self, one.name), one.default) for one in fields(self)}
        return {
            name: value
            for name, (value, default) in values.items()
            if value is not None or default is MISSING
        }

    @classmethod
    def read(cls, path: Path) -> TrainResult | None:
        """What a job left; None where it left nothing. Keys of other versions are passed over."""
        if not path.exists():
            return None
        names = {one.name for one in fields(cls)}
        return cls(**{key: value for key, value in read_json(path).items() if key in names})

    @property
    def peak_memory_mib(self) -> float | None:
        """Of the leader's device; None where it does not count, as on a CPU."""
        return self.device.get("peak_memory_mib")
