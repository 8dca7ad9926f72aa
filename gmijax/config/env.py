"""The task and its simulator."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from types import MappingProxyType
from typing import Literal

from gmijax.config.randomization import LeafRange
from gmijax.config.schema import KeyGroup, doc
from gmijax.errors import ConfigError

_EXAMPLES: Mapping[str, str] = MappingProxyType(
    {"brax": "ant", "playground": "CartpoleBalance", "custom": "path/to/cart.py:make"}
)


@dataclass(frozen=True, kw_only=True)
class EnvConfig(KeyGroup):
    """The task."""

    prefix = "env."

    # Whose task it is: env= sets it.
    suite: Literal["gmijax", "brax", "playground", "custom"] = "gmijax"
    name: str | None = doc(
        "name of the task; with env=brax or env=playground one of theirs (Playground downloads "
        "robot models at first use), with env=custom PATH.py:FUNCTION"
    )
    episode_length: int | None = doc(
        "steps after which an episode is truncated (time limit); null: the task's own", low=1
    )
    # Digest of a custom task's file: the run itself notes it.
    source_sha256: str | None = None
    randomize: Literal["off", "on"] = doc(
        "whether every world has a physics model of its own, drawn from env.randomization",
        default="off",
    )
    randomization: Mapping[str, LeafRange] = dataclasses.field(
        default_factory=dict,
        metadata={"doc": "leaves of the physics model: operation, range, names, draw"},
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name is None:
            example = _EXAMPLES.get(self.suite, "ant")
            raise ConfigError(
                f"env.name: must be given with env={self.suite}, e.g. env.name={example}"
            )
        for leaf, drawn in self.randomization.items():
            drawn.check(leaf)
        if self.randomize == "on" and not self.randomization:
            raise ConfigError("env.randomize=on: env.randomization names nothing to draw")

    @property
    def label(self) -> str:
        """Name of the task in files and messages: `ant`, `brax/ant`, `cart.py:make`."""
        if self.suite == "custom":
            return PurePath(str(self.name)).name
        return str(self.name) if self.suite == "gmijax" else f"{self.suite}/{self.name}"

    @property
    def slug(self) -> str:
        """The task in the name of a run folder: `ant`, `brax-ant`, `cart`."""
        if self.suite == "custom":
            return PurePath(self.label.rpartition(":")[0]).stem
        return self.label.replace("/", "-")


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """The simulator."""

    impl: Literal["auto", "jax", "warp"] = doc("MJX implementation")
