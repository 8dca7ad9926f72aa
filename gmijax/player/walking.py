"""The walking test: does a robot follow its commands, and stay on its feet? No jax here.

The same numbers for every library and every simulator: they are computed from a `Recording`,
whatever made it. The marks are ours; no test of walking is agreed on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.player.joystick import Ground, Robot

Floats = npt.NDArray[np.float32]
Flags: TypeAlias = npt.NDArray[Any]
"""Of bool; what comparisons give has no narrower type."""

LENGTH_S: Final = 20.0
NUM_ENVS: Final = 1000
ONE_ACTION: Final = "the walking test takes 1 only"
"""The error for another `env.action_repeat`."""
SETTLING_S: Final = 0.5
"""After the start, a new command and a push errors do not count in `settled`."""

MOST_TILT_DEG: Final = 60.0

LEAST_UPRIGHT: Final = 0.99
MOST_LINEAR_ERROR_M_PER_S: Final = 0.25
MOST_YAW_ERROR_RAD_PER_S: Final = 0.25
MOST_LEFT: Final = 0.5
"""Most of the environments that may leave the field: the others show how the policy walks."""

LEAST_ENVS: Final = 100
"""With fewer environments 99 % cannot be distinguished from less, and the test does not decide."""


class Recording(NamedTuple):
    """T control steps of N environments from one start each; nothing starts over.

    Attributes:
      qpos: [T, N, 7 + J] after each step: the trunk's position and quaternion, then joints.
      velocity: [T, N, 3] forward, sideways (m/s) and yaw rate (rad/s), in the body frame.
      command: [T, N, 3] what was commanded during the step, in the same units.
      disturbed: [T, N] bool, there was a push in the step, or a new command at its end.
      load: [T, N, A] torque of every driven joint over its limit.
      done: [T, N] bool, the task would end here by its own rule.

    Arrays are of numpy, and of JAX while they are recorded there.
    """

    qpos: Any
    velocity: Any
    command: Any
    disturbed: Any
    load: Any
    done: Any


class Errors(NamedTuple):
    """Root mean squares over steps of all environments; None where no step counts.

    Attributes:
      linear_m_per_s: of the length of commanded minus actual planar velocity.
      yaw_rad_per_s: of commanded minus actual yaw rate.
    """

    linear_m_per_s: float | None
    yaw_rad_per_s: float | None


class Walk(NamedTuple):
    """What the test found.

    Attributes:
      walks: whether it passes all criteria; None of fewer than `LEAST_ENVS` environments.
      num_envs: N.
      length_s: seconds that an environment is watched for.
      upright: share that does not fall, of those that do not leave the field; None if all leave.
      not_done: the same if nothing but the task's own end is a fall.
      left: share that leaves the field, which is neither.
      falls: how many environments fell, by what was seen first.
      settled: errors `SETTLING_S` after the start, the last new command and the last push.
      all_steps: errors in all steps.
      load_rms: root mean square of torque over limit; None for a robot without limits.
      load_p99: its 99th percentile.
      jerk_rad_per_s3: root mean square of the third difference of the joints' positions over
        control steps, divided by the cube of a step's seconds.
      settings: numbers of the task that are not its own, which the caller adds.
    """

    walks: bool | None
    num_envs: int
    length_s: float
    upright: float | None
    not_done: float | None
    left: float
    falls: Mapping[str, int]
    settled: Errors
    all_steps: Errors
    load_rms: float | None
    load_p99: float | None
    jerk_rad_per_s3: float | None
    settings: Mapping[str, float] = MappingProxyType({})

    def as_json(self) -> dict[str, Any]:
        """As plain data."""
        errors = {name: getattr(self, name)._asdict() for name in ("settled", "all_steps")}
        plain = {name: dict(getattr(self, name)) for name in ("falls", "settings")}
        return {**self._asdict(), **plain, **errors}


def measure(steps: Recording, robot: Robot, ground: Ground, control_dt_s: float) -> Walk:
    """Computes the test's numbers; an environment counts until it falls or leaves the field."""
    causes = _falls(steps, robot, ground)
    with np.errstate(invalid="ignore"):
        left = np.any(np.abs(steps.qpos[..., :2]) > ground.edge_m, -1)
    fallen = np.any(list(causes.values()), axis=0)
    running = ~np.logical_or.accumulate(np.logical_or(fallen, left))
    has_fallen, has_left = _which_first(fallen, left)
    settled = running & _settled(steps.disturbed, control_dt_s)
    upright, share_left = _share(has_fallen, has_left), float(has_left.mean())
    loads = _loads(steps.load[running])
    errors, num_envs = _errors(steps, settled), running.shape[1]
    return Walk(
        walks=_walks(upright, share_left, errors) if num_envs >= LEAST_ENVS else None,
        num_envs=num_envs,
        length_s=len(running) * control_dt_s,
        upright=upright,
        not_done=_share(*_which_first(steps.done, left)),
        left=share_left,
        falls=_counts(causes, has_fallen),
        settled=errors,
        all_steps=_errors(steps, running),
        jerk_rad_per_s3=_jerk(steps.qpos[..., 7:], running, control_dt_s),
        load_rms=loads["load_rms"],
        load_p99=loads["load_p99"],
    )


def _falls(steps: Recording, robot: Robot, ground: Ground) -> dict[str, Flags]:
    """Steps [T, N] that are a fall, by cause."""
    position, quaternion = steps.qpos[..., :3], steps.qpos[..., 3:7]
    finite = np.isfinite(steps.qpos).all(-1)
    with np.errstate(invalid="ignore", over="ignore"):
        height = position[..., 2] - ground.height_m(position[..., :2])
        squares = np.square(quaternion)
        # The z of the trunk's own z axis.
        up = 1 - 2 * (squares[..., 1] + squares[..., 2]) / squares.sum(-1)
        low: Any = height < robot.height_m / 2
        tilted: Any = up < np.cos(np.radians(MOST_TILT_DEG))
    return {
        "not_finite": ~finite,
        "low": low & finite,
        "tilted": tilted & finite,
        "done": steps.done & finite,
    }


def _which_first(fallen: Flags, left: Flags) -> tuple[Flags, Flags]:
    """Of each environment [N], whether it fell and whether it left; what came first counts."""
    first_fall, first_exit = (np.where(x.any(0), x.argmax(0), len(x)) for x in (fallen, left))
    return fallen.any(0) & (first_fall <= first_exit), left.any(0) & (first_exit < first_fall)


def _share(fallen: Flags, left: Flags) -> float | None:
    return None if left.all() else float((~fallen & ~left).sum() / (~left).sum())


def _counts(causes: Mapping[str, Flags], fallen: Flags) -> dict[str, int]:
    """How many fell by which cause; of several in one step the first one named counts."""
    firsts = np.stack([np.where(x.any(0), x.argmax(0), len(x)) for x in causes.values()])
    which = firsts.argmin(0)[fallen]
    return {name: int((which == number).sum()) for number, name in enumerate(causes)}


def _settled(disturbed: Flags, control_dt_s: float) -> Flags:
    """Steps [T, N] that are long enough after the start and after all disturbances."""
    step = np.arange(len(disturbed))[:, None]
    last = np.maximum.accumulate(np.where(disturbed, step, -1), axis=0)
    return step - last > round(SETTLING_S / control_dt_s)


def _errors(steps: Recording, counted: Flags) -> Errors:
    if not counted.any():
        return Errors(None, None)
    error = np.square(steps.command[counted] - steps.velocity[counted], dtype=np.float64)
    return Errors(float(np.sqrt(error[:, :2].sum(-1).mean())), float(np.sqrt(error[:, 2].mean())))


def _walks(upright: float | None, left: float, errors: Errors) -> bool:
    linear, yaw = errors
    if left > MOST_LEFT or upright is None or linear is None or yaw is None:
        return False
    is_close = linear <= MOST_LINEAR_ERROR_M_PER_S and yaw <= MOST_YAW_ERROR_RAD_PER_S
    return upright >= LEAST_UPRIGHT and is_close


def _loads(loads: Floats) -> dict[str, float | None]:
    """Of loads [K, A], which are zero where a joint has no limit."""
    if not loads.any():
        return {"load_rms": None, "load_p99": None}
    return {
        "load_rms": float(np.sqrt(np.square(loads, dtype=np.float64).mean())),
        "load_p99": float(np.percentile(loads, 99)),
    }


def _jerk(joints: Floats, running: Flags, control_dt_s: float) -> float | None:
    counted = running[3:]
    if not counted.any():
        return None
    third = np.diff(joints, n=3, axis=0)[counted]
    return float(np.sqrt(np.square(third, dtype=np.float64).mean()) / control_dt_s**3)


def lines_of(walk: Mapping[str, Any]) -> Sequence[str]:
    """The test for people; `walk` as `Walk.as_json` returns it."""
    falls = ", ".join(f"{count} {name}" for name, count in walk["falls"].items() if count)
    settled, every = walk["settled"], walk["all_steps"]
    changed = ", ".join(f"{name}={value:g}" for name, value in walk["settings"].items())
    walks = {True: "yes", False: "no", None: f"too few to say (at least {LEAST_ENVS})"}
    return (
        f"walking test: {walk['num_envs']} environments, {walk['length_s']:.0f} s each, pushes on",
        *([f"  settings that are not the task's own: {changed}"] if changed else []),
        f"  do not fall: {_percent(walk['upright'])} (at least {LEAST_UPRIGHT:.0%})"
        f"; falls: {falls or 'none'}; left the field: {_percent(walk['left'])}"
        f" (at most {MOST_LEFT:.0%})",
        f"  by the task's own end alone: {_percent(walk['not_done'])}",
        f"  error of velocity: {_number(settled['linear_m_per_s'])} m/s"
        f" (at most {MOST_LINEAR_ERROR_M_PER_S}); in all steps {_number(every['linear_m_per_s'])}",
        f"  error of yaw rate: {_number(settled['yaw_rad_per_s'])} rad/s"
        f" (at most {MOST_YAW_ERROR_RAD_PER_S}); in all steps {_number(every['yaw_rad_per_s'])}",
        f"  torque over limit: RMS {_percent(walk['load_rms'])},"
        f" 99th percentile {_percent(walk['load_p99'])};"
        f" jerk of joints: RMS {_number(walk['jerk_rad_per_s3'], '.3g')} rad/s^3",
        f"  walks: {walks[walk['walks']]}",
    )


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def _number(value: float | None, how: str = ".3f") -> str:
    return "-" if value is None else format(value, how)
