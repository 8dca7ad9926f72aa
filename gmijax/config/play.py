"""All keys of `python -m gmijax.play` and `gmijax.export`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Literal

from gmijax.config.env import EnvConfig, PhysicsConfig
from gmijax.config.schema import KeyGroup, doc, require_between

FILMED: Final = 4
"""Environments that a film shows."""

_OF_THE_FILM: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "num_envs": 16,
        "seed": 0,
        "deterministic": True,
        "randomize": "off",
        "max_steps": None,
        "video_envs": None,
        "camera": None,
    }
)
"""Keys that make another film of the same policy, and the defaults of `configs/play.yaml`."""


@dataclass(frozen=True, kw_only=True)
class PlayRunConfig(KeyGroup):
    """The run whose policy is played or exported."""

    prefix = "run."

    dir: str | None = doc("run folder, or `last`; null: the run of `checkpoint`, else `last`")
    env: str | None = doc(
        "the run's custom task, PATH.py:FUNCTION, where its file has changed or moved since; with "
        "checkpoint=shipped the task; env= is short for it; null: as the run noted it",
        default=None,
    )
    # Digest of that file: the controller notes it for its child.
    env_sha256: str | None = None

    def task(self, env: EnvConfig) -> EnvConfig:
        """The task `env` of the run, with the file that the controller has noted for its child."""
        if self.env is None:
            return env
        return dataclasses.replace(env, name=self.env, source_sha256=self.env_sha256)


@dataclass(frozen=True, kw_only=True)
class ExportRunConfig(PlayRunConfig):
    """The run whose policy is exported."""

    env: str | None = doc(
        "the run's custom task, PATH.py:FUNCTION, where its file has changed or moved since; env= "
        "is short for it; null: as the run noted it",
        default=None,
    )


@dataclass(frozen=True, kw_only=True)
class ViewRunConfig(PlayRunConfig):
    """The run whose policy is shown."""

    env: str | None = doc(
        "the task, with checkpoint=shipped; env= is short for it; null: that of the run",
        default=None,
    )


@dataclass(frozen=True, kw_only=True)
class PlayConfig(KeyGroup):
    """All keys of `python -m gmijax.play`."""

    run: PlayRunConfig
    physics: PhysicsConfig
    checkpoint: str | None = doc(
        "folder of a checkpoint, its env steps, or `best`: the one with the best return, in "
        "evaluations (eval.every), else in the training around it; null: the latest. `shipped`, "
        "with env=TASK: the policy that comes with gmijax, in MuJoCo in C"
    )
    num_envs: int = doc("environments, one episode each", low=1)
    seed: int = doc("seed of the episodes' starts and of sampled actions", low=0, high=2**31 - 1)
    deterministic: bool = doc("act with the policy's mean; false: sample actions")
    randomize: Literal["off", "on"] = doc(
        "play with models drawn from the run's env.randomization; off: with the model as it is",
        default="off",
    )
    max_steps: int | None = doc(
        "cut episodes off after this many steps; null: only the task does", low=1
    )
    walking_envs: int | None = doc(
        "environments of the walking test, which the robots go1, g1, t1 and spot have "
        "(docs/walking.md); 0: no test; null: 1000, or none where there is no GPU",
        default=None,
        low=0,
    )
    video: Literal["auto", "mp4", "gif", "both", "none"] = doc(
        "what to film; auto: mp4, or nothing where there is no headless OpenGL"
    )
    video_envs: int | None = doc(
        "how many of the environments are shown, in a grid: evenly spread over the order of their "
        "returns; null: 4, or all if there are fewer"
    )
    html: Literal["auto", "on", "off"] = doc(
        "write a page with the filmed environments in 3D, for a browser; auto: where the extra "
        "`view` is installed"
    )
    width: int = doc("width of the picture in pixels", low=64, high=4096)
    height: int = doc("height of the picture in pixels", low=64, high=4096)
    camera: str | None = doc(
        "name of a camera of the model; null: `track`, else one that follows a body, else a view "
        "that follows a robot that moves freely, else one that stands still"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.video_envs is not None:
            require_between("video_envs", self.video_envs, 1, self.num_envs)

    @property
    def num_filmed(self) -> int:
        """How many environments are shown."""
        return min(FILMED, self.num_envs) if self.video_envs is None else self.video_envs

    def film_overrides(self) -> str:
        """What a command line that makes the same film has beside the policy; begins with ` `."""
        values = {key: getattr(self, key) for key in _OF_THE_FILM}
        own = {key: value for key, value in values.items() if value != _OF_THE_FILM[key]}
        shown = {k: str(v).lower() if isinstance(v, bool) else v for k, v in own.items()}
        return "".join(f" {key}={value}" for key, value in shown.items())


@dataclass(frozen=True, kw_only=True)
class ExportConfig(KeyGroup):
    """All keys of `python -m gmijax.export`."""

    run: ExportRunConfig
    checkpoint: str | None = doc(
        "folder of a checkpoint, its env steps, or `best`: the one with the best return, in "
        "evaluations (eval.every), else in the training around it; null: the latest"
    )
    format: Literal["onnx", "stablehlo", "all"] = doc(
        "what to write: onnx for ONNX Runtime and others, stablehlo for jax.export, or all"
    )
