"""What domain randomisation may draw, and its checks that need no model. No jax, no mujoco."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from gmijax.config.schema import doc, require_at_least, require_positive, suggestion
from gmijax.errors import ConfigError

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
"""Leaves of the physics model that may differ from world to world, and what their names name."""


NEVER_ZERO = ("body_mass", "geom_friction", "pair_friction")
"""Leaves that MJX divides by."""


@dataclass(frozen=True, kw_only=True)
class LeafRange:
    """How one leaf of the physics model is drawn, once for every world of the job."""

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
