"""The robots of `env=go1` and others: what `env.settings` changes in MuJoCo Playground's tasks.

No jax here: the controller checks settings before it starts anything. A test compares what is
written here with the configurations of Playground 0.2.0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from gmijax.config import EnvConfig
from gmijax.config.env import ROBOTS
from gmijax.config.schema import doc
from gmijax.errors import ConfigError
from gmijax.sim.impl import WarpSizes
from gmijax.sim.tasks.settings import TaskSettings


def _action_scale(default: float) -> Any:
    what = "way of a joint's target from the default pose at full action, rad"
    return doc(what, default=default, positive=True)


@dataclass(frozen=True, kw_only=True)
class RobotSettings(TaskSettings):
    """What all robots share. Pushes are forces of a moment, but for humanoids."""

    action_scale_rad: float = _action_scale(0.5)
    noise: float = doc("factor of the noise in observations; 0: none", default=1.0, low=0)
    push: float = doc("1: the robot is pushed now and then; 0: never", default=0.0)
    push_min_m_per_s: float = doc(
        "pushes: least force; it changes the trunk's velocity by 1/pi of this, m/s",
        default=0.0,
        low=0,
    )
    push_max_m_per_s: float = doc(
        "pushes: largest force; it changes the trunk's velocity by 1/pi of this, m/s",
        default=3.0,
        low=0,
    )
    tracking_sigma: float = doc(
        "an error e in following the command earns exp(-e^2 / this); m^2/s^2, rad^2/s^2",
        default=0.25,
        positive=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.push not in (0.0, 1.0):
            raise ConfigError(f"{self.prefix}push={self.push!r}: must be 0 or 1")
        self._require_order("push_min_m_per_s", "push_max_m_per_s")

    def overrides(self) -> dict[str, Any]:
        """Keys of Playground's configuration, with dots, and their values."""
        return {
            "action_scale": self.action_scale_rad,
            "reward_config.tracking_sigma": self.tracking_sigma,
        }

    def _pushes(self, group: str, strength: str) -> dict[str, Any]:
        return {
            f"{group}.enable": bool(self.push),
            f"{group}.{strength}": [self.push_min_m_per_s, self.push_max_m_per_s],
        }


@dataclass(frozen=True, kw_only=True)
class Go1Settings(RobotSettings):
    """`go1`, `go1_rough`: commands are as fast backwards as forwards."""

    command_forward_m_per_s: float = doc(
        "commands: fastest forwards and backwards, m/s", default=1.5, low=0
    )
    command_left_m_per_s: float = doc("commands: fastest sideways, m/s", default=0.8, low=0)
    command_yaw_rad_per_s: float = doc("commands: fastest turn, rad/s", default=1.2, low=0)

    def overrides(self) -> dict[str, Any]:
        """See `RobotSettings.overrides`."""
        return {
            **super().overrides(),
            **self._pushes("pert_config", "velocity_kick"),
            "noise_config.level": self.noise,
            "command_config.a": [
                self.command_forward_m_per_s,
                self.command_left_m_per_s,
                self.command_yaw_rad_per_s,
            ],
        }


@dataclass(frozen=True, kw_only=True)
class RangedSettings(RobotSettings):
    """Robots whose commands have a range of their own in each direction."""

    command_forward_min_m_per_s: float = doc("commands: least speed forwards, m/s", default=-1.0)
    command_forward_max_m_per_s: float = doc("commands: most speed forwards, m/s", default=1.0)
    command_left_min_m_per_s: float = doc("commands: least speed to the left, m/s", default=-0.8)
    command_left_max_m_per_s: float = doc("commands: most speed to the left, m/s", default=0.8)
    command_yaw_min_rad_per_s: float = doc("commands: least turn to the left, rad/s", default=-1.0)
    command_yaw_max_rad_per_s: float = doc("commands: most turn to the left, rad/s", default=1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for low in ("forward_min_m_per_s", "left_min_m_per_s", "yaw_min_rad_per_s"):
            self._require_order(f"command_{low}", f"command_{low.replace('_min_', '_max_')}")

    def _commands(self, group: str) -> dict[str, Any]:
        return {
            f"{group}lin_vel_x": [
                self.command_forward_min_m_per_s,
                self.command_forward_max_m_per_s,
            ],
            f"{group}lin_vel_y": [self.command_left_min_m_per_s, self.command_left_max_m_per_s],
            f"{group}ang_vel_yaw": [
                self.command_yaw_min_rad_per_s,
                self.command_yaw_max_rad_per_s,
            ],
        }


@dataclass(frozen=True, kw_only=True)
class HumanoidRobotSettings(RangedSettings):
    """`t1`, `t1_rough`, and what `g1` shares with it."""

    action_scale_rad: float = _action_scale(1.0)
    push: float = doc("1: the robot is pushed now and then; 0: never", default=1.0)
    push_min_m_per_s: float = doc(
        "pushes: least change of the trunk's velocity, m/s", default=0.1, low=0
    )
    push_max_m_per_s: float = doc(
        "pushes: largest change of the trunk's velocity, m/s", default=1.0, low=0
    )

    def overrides(self) -> dict[str, Any]:
        """See `RobotSettings.overrides`."""
        return {
            **super().overrides(),
            **self._pushes("push_config", "magnitude_range"),
            **self._commands(""),
            "noise_config.level": self.noise,
        }


@dataclass(frozen=True, kw_only=True)
class G1Settings(HumanoidRobotSettings):
    """`g1`, `g1_rough`."""

    action_scale_rad: float = _action_scale(0.5)
    push_max_m_per_s: float = doc(
        "pushes: largest change of the trunk's velocity, m/s", default=2.0, low=0
    )
    command_left_min_m_per_s: float = doc("commands: least speed to the left, m/s", default=-0.5)
    command_left_max_m_per_s: float = doc("commands: most speed to the left, m/s", default=0.5)


@dataclass(frozen=True, kw_only=True)
class SpotSettings(RangedSettings):
    """`spot`."""

    action_scale_rad: float = _action_scale(0.3)

    def overrides(self) -> dict[str, Any]:
        """See `RobotSettings.overrides`. Its noise has no level."""
        noise = {name: self.noise * scale for name, scale in _SPOT_NOISE.items()}
        return {
            **super().overrides(),
            **self._pushes("pert_config", "velocity_kick"),
            **self._commands("command_config."),
            **{f"obs_noise.scales.{name}": scale for name, scale in noise.items()},
            "obs_noise.scales.feet_pos": [self.noise * scale for scale in _SPOT_FEET_NOISE],
        }


_SPOT_NOISE: Mapping[str, float] = MappingProxyType(
    {"joint_pos": 0.05, "gyro": 0.1, "gravity": 0.03}
)
_SPOT_FEET_NOISE = (0.01, 0.005, 0.02)

PUSH_STRENGTH = ("push_min_m_per_s", "push_max_m_per_s")

ROBOT_SETTINGS: Mapping[str, type[RobotSettings]] = MappingProxyType(
    {
        "go1": Go1Settings,
        "go1_rough": Go1Settings,
        "g1": G1Settings,
        "g1_rough": G1Settings,
        "t1": HumanoidRobotSettings,
        "t1_rough": HumanoidRobotSettings,
        "spot": SpotSettings,
    }
)
"""The names of `ROBOTS` -> their settings."""

BUFFERS: Mapping[str, WarpSizes] = MappingProxyType(
    {
        "G1JoystickRoughTerrain": WarpSizes(contacts_per_env=16, constraints_per_env=128),
        "Go1JoystickRoughTerrain": WarpSizes(contacts_per_env=8, constraints_per_env=60),
        "T1JoystickRoughTerrain": WarpSizes(contacts_per_env=16, constraints_per_env=96),
    }
)
"""MJX-Warp's buffers for Playground's tasks on rough ground. Its own are too small, or written by
the constructor over what was configured (Go1). In MuJoCo in C an environment, fallen robots too,
had at most 21 contacts and 113 rows (G1), 16 and 88 (T1), 9 and 48 (Go1). All environments share
the buffer of contacts, so one may need more than its part."""


def playground_name(name: str) -> str:
    """Playground's name of a task, given that or one of `ROBOTS`."""
    return ROBOTS.get(name, name)


def robot_name(name: str) -> str | None:
    """The name in `ROBOTS` of a task, given that or Playground's; None of another task."""
    return next((ours for ours, theirs in ROBOTS.items() if name in (ours, theirs)), None)


def changed_settings(env: EnvConfig) -> dict[str, float]:
    """A robot's settings that are not the task's own, those of pushes and rewards left out.

    The walking test has the task's own pushes, and asks for no reward.
    """
    defaults = vars(ROBOT_SETTINGS[str(env.name)]()) if env.name in ROBOT_SETTINGS else {}
    return {
        name: value
        for name, value in env.settings.items()
        if value != defaults.get(name)
        and name not in ("push", *PUSH_STRENGTH, "tracking_sigma")
        and not name.endswith(".enable")
        and not name.startswith("reward_config.")
    }
