"""Robots of MuJoCo Playground's joystick tasks: what their policies see, how they are judged.

No jax here. What reads a robot's state takes `mjx.Data` as well as `mujoco.MjData`, of one
environment or of many.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.config import EnvConfig
from gmijax.config.env import ROBOTS as NAMES
from gmijax.sim.robots import PUSH_STRENGTH, robot_name

EDGE_M: Final = 9.5
"""Rough terrain ends 10 m from its middle, and beyond it is nothing."""

NO_LIMIT_N_M: Final = 1000.0
"""A torque limit of Playground's Spot, which means that there is none."""


class Robot(NamedTuple):
    """A robot as Playground's joystick tasks have it.

    Attributes:
      name: short name; tasks on rough terrain have the same robots.
      keyframe: the pose that actions are added to, and in which episodes start, or near it.
      height_m: of the trunk above flat ground in that keyframe.
      suffix: of the names of the IMU's sensors and of its site.
      layout: parts of the policy's observation, in order; see `part_sizes`.
      pushes: group of Playground's configuration that has them: `pert_config` are forces of a
        moment, `push_config` sudden changes of the velocity.
      body: that is pushed by forces.
      redrawn_steps: control steps after which a new command is drawn; None: at random times.
      gait_hz: range of the frequency of the gait's clock; None: the robot has none.
      zero_command_phase_rad: what the two legs' phases are set to while the command is zero; they
        continue from there. None: the clock is not changed.
      up_sensor: z axis of a part of the body, by which the task detects that the robot has fallen:
      least_up: if its z is less than this.
      touch_sensors: contacts by which it detects that too.
    """

    name: str
    keyframe: str
    height_m: float
    suffix: str
    layout: tuple[str, ...]
    pushes: str
    body: str
    redrawn_steps: int | None
    gait_hz: tuple[float, float] | None = None
    zero_command_phase_rad: tuple[float, float] | None = None
    up_sensor: str = "upvector"
    least_up: float = 0.0
    touch_sensors: tuple[str, ...] = ()


_JOINTS = ("joint_pos", "joint_vel", "last_action")
_GO1 = ("linvel", "gyro", "gravity", *_JOINTS, "command")
_HUMANOID = ("linvel", "gyro", "gravity", "command", *_JOINTS, "phase")
# Not gravity in the frame of the trunk, but the trunk's own z axis in that of the world.
_SPOT = ("gyro", "up_axis", "joint_pos", "joint_errors", "feet_pos", "last_action", "command")

ROBOTS: Final[Mapping[str, Robot]] = MappingProxyType(
    {
        "go1": Robot("go1", "home", 0.278, "", _GO1, "pert_config", "trunk", None),
        "g1": Robot(
            *("g1", "knees_bent", 0.755, "_pelvis", _HUMANOID, "push_config", "torso_link", 501),
            gait_hz=(1.25, 1.5),
            up_sensor="upvector_torso",
            touch_sensors=("right_foot_left_foot_found",),
        ),
        "t1": Robot(
            *("t1", "home", 0.665, "", _HUMANOID, "push_config", "Trunk", 501),
            gait_hz=(1.25, 1.75),
            zero_command_phase_rad=(np.pi, np.pi),
        ),
        "spot": Robot(
            *("spot", "home", 0.46, "", _SPOT, "pert_config", "body", 201),
            least_up=0.85,
        ),
    }
)
"""By their names in `gmijax.config.env.ROBOTS`, those of rough terrain left out."""


def robot_of(env: EnvConfig) -> Robot | None:
    """The robot of one of Playground's joystick tasks, None of another task."""
    if env.suite != "playground":
        return None
    name = robot_name(str(env.name))
    return None if name is None else ROBOTS[name.removesuffix("_rough")]


def with_pushes(env: EnvConfig, robot: Robot) -> EnvConfig:
    """The task with its own pushes, as the walking test has it, however strong a run had them."""
    key = "push" if env.name in NAMES else f"{robot.pushes}.enable"
    return dataclasses.replace(env, settings={**with_own_pushes(env.settings), key: 1.0})


def with_own_pushes(settings: Mapping[str, float]) -> dict[str, float]:
    """A robot's settings with pushes as strong as the task has them, where it has any."""
    return {name: value for name, value in settings.items() if name not in PUSH_STRENGTH}


def part_sizes(robot: Robot, num_joints: int) -> tuple[tuple[str, int], ...]:
    """Name and length of every part of the policy's observation, in order."""
    joints = dict.fromkeys(_JOINTS, num_joints)
    more = {"phase": 4, "joint_errors": 3 * num_joints, "feet_pos": 12}
    sizes: Mapping[str, int] = joints | more
    return tuple((part, sizes.get(part, 3)) for part in robot.layout)


class Readings:
    """Where in a simulator's data the numbers of a robot are.

    Attributes:
      torque_limit_n_m: [A] float32 of every joint that is driven; infinite where there is none.

    Args:
      model: `mujoco.MjModel`.
      robot: whose model it is.
    """

    def __init__(self, model: Any, robot: Robot) -> None:
        linvel, gyro = (
            int(model.sensor(f"{name}{robot.suffix}").adr[0]) for name in ("local_linvel", "gyro")
        )
        self._velocity = np.array([linvel, linvel + 1, gyro + 2])
        joints = model.actuator_trnid[:, 0]
        self._dofs = model.jnt_dofadr[joints]
        limits = [
            np.where(limited, np.abs(ranges).min(-1), np.inf)
            for limited, ranges in (
                (model.actuator_forcelimited, model.actuator_forcerange),
                (model.jnt_actfrclimited[joints], model.jnt_actfrcrange[joints]),
            )
        ]
        least = np.minimum(*limits)
        self.torque_limit_n_m = np.where(least < NO_LIMIT_N_M, least, np.inf).astype(np.float32)

    def velocity(self, data: Any) -> Any:
        """Forward and sideways velocity in m/s and yaw rate in rad/s [..., 3], in the body frame.

        As Playground's rewards have them: without noise, of the IMU.
        """
        return data.sensordata[..., self._velocity]

    def load(self, data: Any) -> Any:
        """Size of the torque that every driven joint gets, as a part of its limit [..., A]."""
        return abs(data.qfrc_actuator[..., self._dofs]) / self.torque_limit_n_m


class Ground:
    """The height of the ground in a model whose floor is flat, or a field of heights.

    Attributes:
      edge_m: |x| or |y| beyond which a robot has left the field; infinite on flat ground.
    """

    def __init__(self, model: Any) -> None:
        self._heights = None
        self.edge_m = np.inf
        if model.nhfield:
            half_x_m, half_y_m, top_m, _ = model.hfield_size[0]
            rows, columns = int(model.hfield_nrow[0]), int(model.hfield_ncol[0])
            self._heights = top_m * np.reshape(
                model.hfield_data[: rows * columns], (rows, columns)
            )
            self._half_m = np.array([half_x_m, half_y_m])
            self.edge_m = EDGE_M

    def height_m(self, xy: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Height [...] of the ground at positions [..., 2], between its samples by bilinear rule.

        Beyond the field it is that of the edge.
        """
        if self._heights is None:
            return np.zeros(xy.shape[:-1], np.float32)
        last = np.array(self._heights.shape)[::-1] - 1  # Of x and of y: a row is along x.
        with np.errstate(invalid="ignore"):
            at = np.nan_to_num((xy + self._half_m) / (2 * self._half_m) * last)
        at = np.clip(at, 0, last)
        low = np.minimum(at.astype(int), last - 1)
        (right, up), (column, row) = np.moveaxis(at - low, -1, 0), np.moveaxis(low, -1, 0)
        heights = self._heights
        below = heights[row, column] * (1 - right) + heights[row, column + 1] * right
        above = heights[row + 1, column] * (1 - right) + heights[row + 1, column + 1] * right
        return below * (1 - up) + above * up
