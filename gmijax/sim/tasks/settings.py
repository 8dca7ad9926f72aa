"""The numbers of our tasks that `env.settings` changes: defaults, units, bounds.

No jax and no mujoco here: the controller checks them before it starts anything.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeVar

from gmijax.config.schema import KeyGroup, doc, from_dict
from gmijax.errors import ConfigError

S = TypeVar("S", bound="TaskSettings")


class TaskSettings(KeyGroup):
    """Base of the settings of a task: a frozen dataclass of numbers, each with `doc`."""

    prefix = "env.settings."

    def _require_order(self, low: str, high: str) -> None:
        if not getattr(self, low) <= getattr(self, high):
            raise ConfigError(
                f"{self.prefix}{low}={getattr(self, low)!r}: must be at most "
                f"{self.prefix}{high}={getattr(self, high)!r}"
            )


def settings_from(cls: type[S], given: Mapping[str, Any] | None) -> S:
    """The settings of a task: those that are `given`, and defaults for the others.

    Raises:
      ConfigError: an unknown name, no number, or one out of bounds.
    """
    return from_dict(cls, given or {}, TaskSettings.prefix)


@dataclass(frozen=True, kw_only=True)
class RunnerSettings(TaskSettings):
    """What tasks share whose robot runs along +x."""

    joint_noise_rad: float = doc(
        "start: noise of every joint's position, +-rad", default=0.2, low=0
    )
    joint_velocity_noise_rad_per_s: float = doc(
        "start: noise of every joint's velocity, +-rad/s", default=0.1, low=0
    )


@dataclass(frozen=True, kw_only=True)
class AntSettings(RunnerSettings):
    """`ant`."""

    death_height_m: float = doc("height of the torso at which it falls, m", default=0.31)
    death_reward: float = doc("reward of the step in which it falls", default=-2.0)


@dataclass(frozen=True, kw_only=True)
class HumanoidSettings(RunnerSettings):
    """`humanoid`."""

    death_height_m: float = doc("height of the torso at which it falls, m", default=0.8)
    death_reward: float = doc("reward of the step in which it falls", default=-1.0)


@dataclass(frozen=True, kw_only=True)
class AnymalSettings(TaskSettings):
    """`anymal`."""

    action_scale_rad: float = doc(
        "way of a joint's target from standing at full action, rad", default=0.5, positive=True
    )
    command_forward_m_per_s: float = doc(
        "commands: fastest forwards and backwards, m/s", default=2.0, low=0
    )
    command_left_m_per_s: float = doc("commands: fastest sideways, m/s", default=1.0, low=0)
    command_yaw_rad_per_s: float = doc("commands: fastest turn, rad/s", default=1.0, low=0)
    start_factor_min: float = doc("start: least factor of a standing position", default=0.5)
    start_factor_max: float = doc("start: largest such factor", default=1.5)
    joint_velocity_noise_rad_per_s: float = doc(
        "start: noise of every joint's velocity, +-rad/s", default=0.1, low=0
    )

    curriculum_start: float = doc(
        "env.curriculum=on: share of the commands' ranges that an environment begins with",
        default=0.25,
        low=0,
        high=1,
    )
    curriculum_growth: float = doc(
        "env.curriculum=on: added to that share by an episode that succeeds", default=0.25, low=0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_order("start_factor_min", "start_factor_max")


@dataclass(frozen=True, kw_only=True)
class BallBalanceSettings(TaskSettings):
    """`ball_balance`."""

    action_speed_rad_per_s: float = doc(
        "speed of a knee's target at full action, rad/s", default=20.0, positive=True
    )
    goal_height_m: float = doc("height of the goal, m", default=0.7)
    fallen_height_m: float = doc("height of the ball at which it has fallen, m", default=0.15)
    start_distance_max_m: float = doc(
        "start: farthest the ball is from the middle, m", default=0.5, low=0.002
    )
    start_height_min_m: float = doc("start: lowest the ball is, m", default=1.0)
    start_height_max_m: float = doc("start: highest the ball is, m", default=2.0)
    start_speed_m_per_s: float = doc(
        "start: speed of the ball downwards, and the most inwards, m/s", default=5.0, low=0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_order("start_height_min_m", "start_height_max_m")


@dataclass(frozen=True, kw_only=True)
class FrankaCabinetSettings(TaskSettings):
    """`franka_cabinet`."""

    arm_speed_rad_per_s: float = doc(
        "speed of the arm's targets at full action, rad/s", default=7.5, positive=True
    )
    finger_speed_m_per_s: float = doc(
        "speed of the fingers' targets at full action, m/s", default=0.75, positive=True
    )
    joint_noise: float = doc(
        "start: noise of every driven joint's position, +-rad (fingers: m)", default=0.125, low=0
    )
    open_m: float = doc(
        "opening from which on the drawer counts as open and the episode is truncated, m",
        default=0.39,
        positive=True,
    )
    open_terminates: float = doc(
        "1: an open drawer terminates the episode, and nothing that could still be earned counts",
        default=0.0,
        low=0,
        high=1,
    )
    distance_scale_m: float = doc(
        "distance from the handle at which `distance` is a quarter of the most, m",
        default=0.3,
        positive=True,
    )
    behind_reward: float = doc(
        "reward of a step with a finger through the drawer's front", default=-1.0
    )
    behind_keeps: float = doc(
        "share of the other terms that such a step keeps", default=1.0, low=0, high=1
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.open_terminates not in (0.0, 1.0):
            raise ConfigError(
                f"{self.prefix}open_terminates={self.open_terminates!r}: must be 0 or 1"
            )


@dataclass(frozen=True, kw_only=True)
class ShadowHandSettings(TaskSettings):
    """`shadow_hand`."""

    reached_rad: float = doc(
        "largest angle to the goal at which it counts as reached, rad", default=0.1, positive=True
    )
    fallen_m: float = doc(
        "distance of the cube from its goal position from which on the episode ends, m",
        default=0.24,
        positive=True,
    )
    cube_noise_m: float = doc("start: noise of the cube's position, +-m", default=0.01, low=0)
    joint_noise: float = doc(
        "start: noise of every joint's position, share of its limits", default=0.2, low=0
    )


SETTINGS: Mapping[str, type[TaskSettings]] = MappingProxyType(
    {
        "ant": AntSettings,
        "anymal": AnymalSettings,
        "ball_balance": BallBalanceSettings,
        "franka_cabinet": FrankaCabinetSettings,
        "humanoid": HumanoidSettings,
        "shadow_hand": ShadowHandSettings,
    }
)
"""Name of a task -> its settings; the list of our tasks."""

CURRICULA = ("anymal",)
"""Tasks whose `make` takes `curriculum=True`."""
