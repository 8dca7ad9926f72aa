"""What a robot's computer must know beside the network: `robot` in the metadata of an export.

From the model and the configuration of one of Playground's joystick tasks, as plain data. The
numbers that Playground has in its code and not in its configuration are those of version 0.2.0.
No jax here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from gmijax.player.joystick import Readings, Robot, part_sizes

LATE: Final = ("last_action", "command", "phase")
"""Parts of an observation that are one control step old: Playground computes an observation
before it notes the action that led to it, draws a command and moves the clock of the gait on."""

_PARTS: Final[Mapping[str, tuple[str, str]]] = {
    "linvel": ("m/s", "velocity of the IMU in its own frame; no robot measures it"),
    "gyro": ("rad/s", "angular velocity in the frame of the IMU"),
    "gravity": ("1", "direction of gravity in the frame of the IMU: (0, 0, -1) upright"),
    "up_axis": ("1", "z axis of the IMU in the frame of the world: (0, 0, 1) upright"),
    "joint_pos": ("rad", "positions of the joints minus the default pose"),
    "joint_vel": ("rad/s", "velocities of the joints"),
    "joint_errors": (
        "rad",
        "positions, as they are in joint_pos, minus targets of the last three steps, newest first",
    ),
    "feet_pos": ("m", "positions of the feet FL, FR, HL, HR in the frame of the IMU"),
    "last_action": ("1", "the action, as the policy gave it"),
    "command": ("m/s, m/s, rad/s", "velocity forwards, to the left, and turn to the left"),
    "phase": ("1", "cosines of the two legs' phases, then their sines"),
}
"""Unit and meaning of every part of an observation."""


def deployment_of(robot: Robot, model: Any, config: Mapping[str, Any]) -> dict[str, Any]:
    """Layout, pose, gains, rates, commands and pushes of a task.

    Args:
      robot: whose task it is.
      model: its `mujoco.MjModel`, as Playground has changed it.
      config: Playground's configuration of the task.
    """
    joints = model.actuator_trnid[:, 0]
    dofs, positions = model.jnt_dofadr[joints], model.jnt_qposadr[joints]
    limits = Readings(model, robot).torque_limit_n_m
    scale = float(config["action_scale"])
    return {
        "name": robot.name,
        "obs": _layout(robot, len(joints), config),
        "joint_names": [model.joint(int(joint)).name for joint in joints],
        "default_pose_rad": model.key(robot.keyframe).qpos[positions].tolist(),
        "kp_n_m_per_rad": model.actuator_gainprm[:, 0].tolist(),
        # Playground has some of it in the motors and some in the joints.
        "kd_n_m_s_per_rad": (model.dof_damping[dofs] - model.actuator_biasprm[:, 2]).tolist(),
        "torque_limit_n_m": [float(x) if np.isfinite(x) else None for x in limits],
        "action_scale_rad": scale,
        "target_range_rad": model.actuator_ctrlrange.tolist(),
        "control_dt_s": float(config["ctrl_dt"]),
        "physics_dt_s": float(config["sim_dt"]),
        "ccd_iterations": int(model.opt.ccd_iterations),
        "phase": _phase(robot),
        "commands": _commands(robot, config),
        "pushes": _pushes(robot, config),
    }


def _layout(robot: Robot, num_joints: int, config: Mapping[str, Any]) -> list[dict[str, Any]]:
    noise = config["noise_config"] if "noise_config" in config else config["obs_noise"]
    level = float(noise.get("level", 1.0))
    parts: list[dict[str, Any]] = []
    start = 0
    for name, length in part_sizes(robot, num_joints):
        unit, meaning = _PARTS[name]
        # Spot's up axis is called gravity there, and its errors have the noise of positions.
        key = {"up_axis": "gravity", "joint_errors": "joint_pos"}.get(name, name)
        amplitude = np.multiply(level, noise["scales"].get(key, 0.0)).tolist()
        parts.append(
            {
                "name": name,
                "start": start,
                "length": length,
                "noise": amplitude,
                "delay_steps": int(name in LATE),
                "unit": unit,
                "meaning": meaning,
            }
        )
        start += length
    return parts


def _phase(robot: Robot) -> dict[str, Any] | None:
    if robot.gait_hz is None:
        return None
    return {
        "hz": list(robot.gait_hz),
        "start_rad": [0.0, np.pi],
        "zero_command_phase_rad": robot.zero_command_phase_rad,
    }


def _commands(robot: Robot, config: Mapping[str, Any]) -> dict[str, Any]:
    if robot.redrawn_steps is None:
        drawn = config["command_config"]
        return {"largest": list(drawn["a"]), "nonzero": list(drawn["b"]), "mean_s": 5.0}
    group = config if "lin_vel_x" in config else config["command_config"]
    ranges = [list(group[name]) for name in ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")]
    every_s = robot.redrawn_steps * float(config["ctrl_dt"])
    return {"ranges": ranges, "zero": 0.1, "every_s": every_s}


def _pushes(robot: Robot, config: Mapping[str, Any]) -> dict[str, Any]:
    drawn = config[robot.pushes]
    enabled = {"enabled": bool(drawn["enable"])}
    if robot.pushes == "push_config":
        return {
            **enabled,
            "change_m_per_s": list(drawn["magnitude_range"]),
            "every_s": list(drawn["interval_range"]),
        }
    return {
        **enabled,
        "body": robot.body,
        "velocity_kick_m_per_s": list(drawn["velocity_kick"]),
        "duration_s": list(drawn["kick_durations"]),
        "wait_s": list(drawn["kick_wait_times"]),
    }
