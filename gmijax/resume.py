"""Finding a checkpoint and checking that it fits, without loading it. No jax here."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from gmijax.errors import ConfigError
from gmijax.rundir import last_run, read_json

META = "meta.json"
"""Written last into a checkpoint: a folder without it is not one."""


@dataclass(frozen=True)
class CheckpointMeta:
    """What a checkpoint holds.

    Attributes:
      env: task name.
      algo: training algorithm.
      env_steps: environment steps of the whole job so far.
      num_gmis: K of the job that wrote it.
      num_envs: N of that job, environments per GMI.
      hidden: widths of the policy and of the value network.
      impl: physics implementation; environment states of one cannot be used by the other.
    """

    env: str
    algo: str
    env_steps: int
    num_gmis: int
    num_envs: int
    hidden: tuple[tuple[int, ...], tuple[int, ...]]
    impl: str

    def to_dict(self) -> dict[str, object]:
        """Plain data for `meta.json`."""
        return asdict(self)

    @classmethod
    def read(cls, checkpoint: Path) -> CheckpointMeta:
        """Reads the meta data of a checkpoint folder."""
        data = read_json(checkpoint / META)
        policy, value = data["hidden"]
        return cls(**{**data, "hidden": (tuple(policy), tuple(value))})


def find_checkpoint(wanted: str, key: str) -> Path:
    """The checkpoint that `wanted` names: `last`, a run folder, or a checkpoint folder.

    `last` is the newest run below `runs/`; a run folder means its latest checkpoint.

    Args:
      wanted: value of the key.
      key: the configuration key, for messages.

    Raises:
      ConfigError: there is none.
    """
    folder = last_run() if wanted == "last" else Path(wanted)
    if (folder / META).is_file():
        return folder.resolve()
    if not folder.is_dir():
        raise ConfigError(f"{key}={wanted}: no such folder")
    found = sorted(path.parent for path in folder.glob(f"checkpoints/[0-9]*/{META}"))
    if not found:
        raise ConfigError(f"{key}={wanted}: no checkpoint in this folder")
    return found[-1].resolve()


def check_fits(meta: CheckpointMeta, wanted: CheckpointMeta, key: str, value: str) -> None:
    """Raises ConfigError if a job like `wanted` cannot continue from a checkpoint `meta`."""
    for name, have, want in (
        ("task", meta.env, wanted.env),
        ("algorithm", meta.algo, wanted.algo),
        ("network widths", _shown(meta.hidden), _shown(wanted.hidden)),
    ):
        if have != want:
            raise ConfigError(f"{key}={value}: checkpoint of {name} {have}, not {want}")


def _shown(hidden: tuple[tuple[int, ...], ...]) -> str:
    return " and ".join(":".join(map(str, widths)) for widths in hidden)
