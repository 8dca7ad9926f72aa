"""Finding a checkpoint and checking that it fits, without loading it. No jax here."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gmijax.config import ALGORITHMS, AlgoConfig, EnvConfig
from gmijax.errors import ConfigError
from gmijax.rundir import META, RunPaths, last_run, read_json
from gmijax.schema import from_dict, from_named


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
        """Reads the meta data of a checkpoint folder.

        Raises:
          ConfigError: they are not those of a checkpoint.
        """
        try:
            return from_dict(cls, _read_object(checkpoint / META))
        except ConfigError as error:
            raise ConfigError(f"checkpoint {checkpoint}: broken {META} ({error})") from None


def find_checkpoint(wanted: str, key: str) -> Path:
    """The checkpoint that `wanted` names: `last`, a run folder, or a checkpoint folder.

    `last` is the run below `runs/` with the newest checkpoint; a run folder means its latest one.

    Args:
      wanted: value of the key.
      key: the configuration key, for messages.

    Raises:
      ConfigError: there is none.
    """
    folder = last_run(key) if wanted == "last" else Path(wanted)
    if (folder / META).is_file():
        return folder.resolve()
    if not folder.is_dir():
        raise ConfigError(f"{key}={wanted}: no such folder")
    found = sorted(path.parent for path in folder.glob(f"checkpoints/[0-9]*/{META}"))
    if not found:
        raise ConfigError(f"{key}={wanted}: no checkpoint in this folder")
    return found[-1].resolve()


def saved_config(checkpoint: Path) -> dict[str, Any]:
    """The configuration of the run that a checkpoint lies in, as plain data.

    Keys that its version of gmijax did not know are missing.

    Raises:
      ConfigError: the checkpoint does not lie in the folder of a training run.
    """
    path = RunPaths(checkpoint.parent.parent).config
    if not path.is_file():
        raise ConfigError(
            f"checkpoint {checkpoint}: no config.json in {path.parent}; "
            "a checkpoint can only be used in its run folder"
        )
    try:
        saved = _read_object(path)
    except ConfigError as error:
        raise ConfigError(f"{path}: broken ({error})") from None
    if not all(isinstance(saved.get(group), dict) for group in ("env", "algo", "run")):
        raise ConfigError(f"{path}: not the configuration of a training run")
    if saved["env"].get("suite") == "custom":
        # A file of which nothing is noted is none that can be recognised.
        saved["env"]["source_sha256"] = saved["env"].get("source_sha256") or ""
    return saved


def trained_config(checkpoint: Path) -> tuple[EnvConfig, AlgoConfig]:
    """Task and algorithm of the run that a checkpoint lies in.

    Raises:
      ConfigError: the checkpoint does not lie in the folder of a training run.
    """
    saved = saved_config(checkpoint)
    algo = from_named(ALGORITHMS, saved["algo"], "algo.")
    return from_dict(EnvConfig, saved["env"], "env."), algo


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


def _read_object(path: Path) -> dict[str, Any]:
    try:
        data: object = read_json(path)
    except OSError as error:
        raise ConfigError(f"cannot read it: {error.strerror}") from None
    except ValueError as error:  # Not JSON, or not even text.
        raise ConfigError(f"not JSON: {error}") from None
    if not isinstance(data, dict):
        raise ConfigError("not a JSON object")
    return data
