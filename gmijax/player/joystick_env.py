"""Playground's joystick tasks in plain MuJoCo by numpy: what runs before a robot does. No jax.

Everything comes from the metadata of an exported policy: a robot's computer does the same but for
commands, pushes and the simulator.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.player.joystick import ROBOTS, Readings, Robot
from gmijax.player.joystick_draws import Commands, pusher_of
from gmijax.player.joystick_model import joystick_model
from gmijax.player.walking import Recording

Floats = npt.NDArray[np.float32]


class _Memory(NamedTuple):
    """What an observation knows of the steps before, and the joints' positions as measured."""

    last_action: npt.NDArray[Any]
    command: npt.NDArray[Any]
    phase: npt.NDArray[Any]
    measured: npt.NDArray[Any]
    joint_errors: npt.NDArray[Any]


class JoystickEnv:
    """One environment.

    Args:
      about: `robot` in the metadata of an export; see `gmijax.player.deployment`.
      terrain: `flat` or `rough`.
      rng: starts, commands and pushes come from it.
      pushes: whether there are any.
      noise: whether observations have that of the training.

    Raises:
      ConfigError: see `joystick_model`.

    Attributes:
      robot: which one it is.
      model: `mujoco.MjModel`, with the gains and the time step of `about`.
      control_dt_s: seconds per step.
      data: `mujoco.MjData`, which `step` moves.
      gait_hz: frequency of the gait's clock, drawn at every start; 0 without one.
    """

    def __init__(
        self,
        about: Mapping[str, Any],
        terrain: Literal["flat", "rough"],
        rng: np.random.Generator,
        *,
        pushes: bool = True,
        noise: bool = True,
    ) -> None:
        self.robot: Robot = ROBOTS[about["name"]]
        self.model = model = joystick_model(self.robot, terrain)
        self.control_dt_s: float = about["control_dt_s"]
        self._about, self._rng = about, rng
        self._pose = np.array(about["default_pose_rad"])
        self._low, self._high = np.array(about["target_range_rad"]).T
        _set_up(model, about)
        # A start over would hide bad numbers, which are a fall.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.data = mujoco.MjData(model)
        self.readings = Readings(model, self.robot)
        self._imu = model.site(f"imu{self.robot.suffix and '_in' + self.robot.suffix}").id
        self._substeps = round(self.control_dt_s / about["physics_dt_s"])
        self._pusher = pusher_of(about, model, rng) if pushes else None
        self._commands = Commands(about, rng)
        amplitudes = {
            part["name"]: noise * np.resize(part["noise"], part["length"]) for part in about["obs"]
        }
        # Measured once in a step: the errors of later ones are of the same numbers.
        self._joint_noise = amplitudes["joint_pos"]
        amplitudes |= {
            name: np.zeros_like(amplitudes[name])
            for name in ("joint_pos", "joint_errors")
            if name in amplitudes
        }
        self._noise = np.concatenate(list(amplitudes.values()))
        self.reset()

    @property
    def command(self) -> npt.NDArray[Any]:
        """What the robot is to do in the next step [3]; observed from its end on. May be set."""
        return self._memory.command

    @command.setter
    def command(self, value: npt.ArrayLike) -> None:
        self._memory = self._memory._replace(command=np.asarray(value, np.float64))

    def reset(self) -> Floats:
        """The next start, as Playground draws it; returns the observation [O]."""
        model, data, rng = self.model, self.data, self._rng
        mujoco.mj_resetDataKeyframe(model, data, model.key(self.robot.keyframe).id)
        if self.robot.name != "spot":  # Which always starts alike.
            data.qpos[:2] += rng.uniform(-0.5, 0.5, 2)
            yaw = rng.uniform(-3.14, 3.14)
            turned, start = np.zeros(4), data.qpos[3:7].copy()
            mujoco.mju_mulQuat(turned, start, np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))
            data.qpos[3:7] = turned
            data.qvel[:6] = rng.uniform(-0.5, 0.5, 6)
        if self.robot.gait_hz is not None:
            data.qpos[7:] *= rng.uniform(0.5, 1.5, len(data.qpos) - 7)
        data.ctrl[:] = data.qpos[7:]
        mujoco.mj_forward(model, data)
        num_joints = len(self._pose)
        phase = self._about["phase"]
        self.gait_hz = 0.0 if phase is None else rng.uniform(*phase["hz"])
        if self._pusher is not None:
            self._pusher.begin()
        self._memory = _Memory(
            last_action=np.zeros(num_joints),
            command=self._commands.begin(),
            phase=np.zeros(2) if phase is None else np.array(phase["start_rad"]),
            measured=np.zeros(num_joints),
            joint_errors=np.zeros(3 * num_joints),
        )
        self._measure_joints(np.zeros(num_joints))
        return self.observe()

    def step(self, action: npt.ArrayLike) -> tuple[Floats, Recording]:
        """One control step.

        Returns:
          The observation [O] to act on next, and the step as a `Recording` of T = N = 1.
        """
        action = np.clip(np.asarray(action, np.float64), -1, 1)
        is_pushed = self._pusher is not None and self._pusher.push(self.data)
        targets = self._pose + self._about["action_scale_rad"] * action
        targets = np.clip(targets, self._low, self._high)  # As the motors of the model do.
        self.data.ctrl[:] = targets
        mujoco.mj_step(self.model, self.data, self._substeps)
        self._measure_joints(targets)
        obs, command = self.observe(), self._memory.command
        # Only now, as Playground does it: see `gmijax.player.deployment.LATE`.
        new = self._commands.next(command)
        self._memory = self._memory._replace(
            last_action=action, command=new, phase=self._next_phase(command)
        )
        return obs, self._recorded(command, is_pushed or not np.array_equal(command, new))

    def observe(self) -> Floats:
        """The observation [O] by now. Its noise is drawn anew each time, but for the joints'."""
        data, memory = self.data, self._memory
        axes = data.site_xmat[self._imu].reshape(3, 3)
        suffix = self.robot.suffix
        parts = {
            "gravity": -axes[2],
            "up_axis": axes[:, 2],
            "joint_pos": memory.measured - self._pose,
            "joint_vel": data.qvel[6:],
            **memory._asdict(),
            "phase": np.concatenate([np.cos(memory.phase), np.sin(memory.phase)]),
        }
        sensors = {"linvel": ["local_linvel"], "gyro": ["gyro"], "feet_pos": _FEET}
        for part, names in sensors.items():
            if part in self.robot.layout:
                values = [data.sensor(f"{name}{suffix}").data for name in names]
                parts[part] = np.concatenate(values)
        obs = np.concatenate([parts[name] for name in self.robot.layout])
        noise = self._noise * self._rng.uniform(-1, 1, len(obs))
        return (obs + noise).astype(np.float32)

    def _measure_joints(self, targets: npt.NDArray[Any]) -> None:
        measured = self.data.qpos[7:] + self._joint_noise * self._rng.uniform(-1, 1, len(targets))
        errors = np.roll(self._memory.joint_errors, len(targets))
        errors[: len(targets)] = measured - targets
        self._memory = self._memory._replace(measured=measured, joint_errors=errors)

    def _next_phase(self, command: npt.NDArray[Any]) -> npt.NDArray[Any]:
        about = self._about["phase"]
        if about is None:
            return self._memory.phase
        if np.linalg.norm(command) <= 0.01 and about["zero_command_phase_rad"] is not None:
            return np.array(about["zero_command_phase_rad"])
        phase = self._memory.phase + 2 * np.pi * self.control_dt_s * self.gait_hz
        return np.fmod(phase + np.pi, 2 * np.pi) - np.pi

    def _recorded(self, command: npt.NDArray[Any], is_disturbed: bool) -> Recording:
        data = self.data
        has_fallen = data.sensor(self.robot.up_sensor).data[2] < self.robot.least_up
        touches = any(data.sensor(name).data[0] > 0 for name in self.robot.touch_sensors)
        return Recording(
            qpos=_alone(data.qpos),
            velocity=_alone(self.readings.velocity(data)),
            command=_alone(command),
            disturbed=_alone(is_disturbed),
            load=_alone(self.readings.load(data)),
            done=_alone(has_fallen or touches),
        )


def _alone(value: npt.ArrayLike) -> npt.NDArray[Any]:
    """A copy with axes [T, N] of length 1 in front."""
    return np.array(value)[None, None]


_FEET: Final = ["FL_pos", "FR_pos", "HL_pos", "HR_pos"]


def _set_up(model: Any, about: Mapping[str, Any]) -> None:
    """Gains and physics of the metadata, in lieu of what the file of the model has."""
    kp, kd = np.array(about["kp_n_m_per_rad"]), np.array(about["kd_n_m_s_per_rad"])
    dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    model.opt.timestep = about["physics_dt_s"]
    model.opt.ccd_iterations = about["ccd_iterations"]
    model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1] = kp, -kp
    model.dof_damping[dofs] = kd + model.actuator_biasprm[:, 2]
