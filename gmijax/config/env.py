"""The task, what of its model may be drawn for every environment, and its simulator."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from types import MappingProxyType
from typing import Literal

from gmijax.config.schema import KeyGroup, doc, require_at_least, require_positive, suggestion
from gmijax.errors import ConfigError

_EXAMPLES: Mapping[str, str] = MappingProxyType(
    {"brax": "ant", "playground": "CartpoleBalance", "custom": "path/to/cart.py:make"}
)

ROBOTS: Mapping[str, str] = MappingProxyType(
    {
        "go1": "Go1JoystickFlatTerrain",
        "go1_rough": "Go1JoystickRoughTerrain",
        "g1": "G1JoystickFlatTerrain",
        "g1_rough": "G1JoystickRoughTerrain",
        "t1": "T1JoystickFlatTerrain",
        "t1_rough": "T1JoystickRoughTerrain",
        "spot": "SpotFlatTerrainJoystick",
    }
)
"""Names of ours for tasks of MuJoCo Playground in which a robot follows a command, and theirs."""

RANDOMIZED_LEAVES: Mapping[str, str] = MappingProxyType(
    {
        "body_mass": "bodies",
        "geom_friction": "geoms",
        "pair_friction": "contact pairs",
        "dof_armature": "joints",
        "dof_damping": "joints",
        "dof_frictionloss": "joints",
        "jnt_stiffness": "joints",
        "actuator_gainprm": "actuators",
    }
)
"""Leaves of the physics model that may differ between environments, and what their names name."""

NEVER_ZERO = ("body_mass", "geom_friction", "pair_friction")
"""Leaves that MJX divides by."""


@dataclass(frozen=True, kw_only=True)
class LeafRange:
    """How one leaf of the physics model is drawn."""

    operation: Literal["scale", "add", "set"] = doc(
        "what the drawn number does to the model's own value"
    )
    range: tuple[float, ...] = doc("lowest and highest number; draws are uniform")
    names: tuple[str, ...] | None = doc("elements of the model; null: all", default=None)
    draw: Literal["each", "shared"] = doc(
        "a number for each element, or one that all of them share", default="each"
    )

    def check(self, leaf: str) -> None:
        """Raises ConfigError for what is wrong whatever the model is."""
        key = f"env.randomization.{leaf}"
        if leaf not in RANDOMIZED_LEAVES:
            raise ConfigError(f"{key}: cannot be randomized{suggestion(leaf, RANDOMIZED_LEAVES)}")
        if len(self.range) != 2 or self.range[0] > self.range[1]:
            raise ConfigError(f"{key}.range={list(self.range)}: expected [lowest, highest]")
        if self.names is not None and not self.names:
            raise ConfigError(f"{key}.names=[]: expected at least one name, or null for all")
        if self.operation != "add" and leaf in NEVER_ZERO:
            require_positive(f"{key}.range[0]", self.range[0])
        elif self.operation != "add":
            require_at_least(f"{key}.range[0]", self.range[0], 0.0)


@dataclass(frozen=True, kw_only=True)
class EnvConfig(KeyGroup):
    """The task."""

    prefix = "env."

    # Whose task it is: env= sets it.
    suite: Literal["gmijax", "brax", "playground", "custom"] = "gmijax"
    name: str | None = doc(
        "name of the task; with env=brax or env=playground one of theirs, with env=custom "
        "PATH.py:FUNCTION"
    )
    episode_length: int | None = doc(
        "steps of the task after which an episode is truncated (time limit); null: its own", low=1
    )
    history: int = doc(
        "steps that one observation holds, the oldest first (docs/tasks.md)",
        default=1,
        low=1,
    )
    action_repeat: int = doc(
        "steps of the task that every action is taken for; rewards are summed", default=1, low=1
    )
    # Digest of a custom task's file: the run itself notes it.
    source_sha256: str | None = None
    rewards: Mapping[str, float] = dataclasses.field(
        default_factory=dict,
        metadata={"doc": "weights of the reward's terms (docs/tasks.md); 0: the term is left out"},
    )
    settings: Mapping[str, float] = dataclasses.field(
        default_factory=dict,
        metadata={"doc": "numbers of the task, such as the height of a fall (docs/tasks.md)"},
    )
    curriculum: Literal["off", "on"] = doc(
        "make an environment's episodes harder as they succeed, in tasks that can (docs/tasks.md)",
        default="off",
    )
    randomize: Literal["off", "on", "episode"] = doc(
        "give every environment its own model, drawn from env.randomization, or as Playground "
        "draws it: once (on), or for every episode",
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
        # Tasks of Playground bring what they draw.
        if self.randomize != "off" and not self.randomization and self.suite != "playground":
            raise ConfigError(
                f"env.randomize={self.randomize}: env.randomization names nothing to draw"
            )

    @property
    def label(self) -> str:
        """Name of the task in files and messages: `ant`, `go1`, `brax/ant`, `cart.py:make`."""
        return label_of(self.suite, str(self.name))

    @property
    def words(self) -> str:
        """What chooses the task on a command line: `env=ant`, `env=brax env.name=ant`."""
        name = str(self.name)
        if self.suite == "custom":
            return f"env={shlex.quote(name)}"
        choice = choice_of(self.suite, name)
        return f"env={choice}" if choice == name else f"env={choice} env.name={shlex.quote(name)}"

    @property
    def slug(self) -> str:
        """The task in the name of a run folder: `ant`, `brax-ant`, `cart`."""
        if self.suite == "custom":
            return PurePath(self.label.rpartition(":")[0]).stem
        return self.label.replace("/", "-")


def label_of(suite: str, name: str) -> str:
    """See `EnvConfig.label`."""
    if suite == "custom":
        return PurePath(name).name
    return name if choice_of(suite, name) == name else f"{suite}/{name}"


def choice_of(suite: str, name: str) -> str:
    """What `env=` chooses a task by: `ant`, `go1`; `brax`, with `env.name` beside it."""
    is_ours = suite == "gmijax" or (suite == "playground" and name in ROBOTS)
    return name if is_ours else suite


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """The simulator."""

    impl: Literal["auto", "jax", "warp"] = doc("MJX implementation")
