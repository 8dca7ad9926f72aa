"""What the contract test has to know of a task: a way to die, and how near C MuJoCo it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class OracleLimit(NamedTuple):
    """Largest allowed difference from C MuJoCo in one step, and the controls that it holds for.

    Attributes:
      qvel: rad/s or m/s, after one physics step.
      sensors: N or N m.
      ctrl: controls are drawn from -ctrl to ctrl, around those of the model's keyframe.
      steps: length of the trajectory.
    """

    qvel: float
    sensors: float
    ctrl: float
    steps: int


class TaskCase(NamedTuple):
    """One task.

    Attributes:
      hazard: where in `qpos` [nq] an environment is moved so that the next step ends the episode,
        and the numbers there; None for a task that only time ends.
      oracle: how near to C MuJoCo one physics step must be.
      energy_gain: what a passive robot may gain, as a fraction of the most that it has in motion.
      penetration_m: how deep random actions may press two bodies into each other, metres.
    """

    hazard: tuple[int, Sequence[float]] | None
    oracle: OracleLimit
    energy_gain: float = 0.01
    penetration_m: float = 0.01


CASES = {
    "ant": TaskCase(
        (2, [0.25]),
        # The trajectory ends before the first foot touches the floor: C turns the edges of that
        # contact's friction pyramid by another angle about the normal than MJX 3.17 does.
        OracleLimit(qvel=1e-4, sensors=1e-3, ctrl=0.3, steps=7),
        penetration_m=0.16,  # Random torques throw the light feet about with 20 m/s.
    ),
    "ball_balance": TaskCase(
        (13, [2.0, 0.0, 0.1]),
        # MuJoCo 4 in C predicts how a `connect` will move with the bodies' rotation (the term
        # with the Jacobian's time derivative), MJX 3.17 does not: they part with the legs' speed
        # squared. The ball lands on the tray in step 84.
        OracleLimit(qvel=0.02, sensors=4.0, ctrl=0.02, steps=96),
        penetration_m=0.045,
    ),
    "franka_cabinet": TaskCase(
        None,
        # No actuator reaches its force limit: where one does, MJX-JAX 3.17 goes on to integrate
        # its damping implicitly, C (and MJX-Warp) does not.
        OracleLimit(qvel=1e-4, sensors=0.0, ctrl=0.01, steps=96),
        penetration_m=0.03,
    ),
    "anymal": TaskCase(
        (2, [0.2]),
        # As with ant, the trajectory ends before a foot touches the floor.
        OracleLimit(qvel=1e-3, sensors=0.0, ctrl=0.3, steps=24),
        penetration_m=0.08,
    ),
    "humanoid": TaskCase(
        (2, [0.7]),
        # As with ant and anymal.
        OracleLimit(qvel=1e-3, sensors=0.01, ctrl=0.3, steps=20),
        penetration_m=0.12,
    ),
    "shadow_hand": TaskCase(
        (24, [0.0, -0.39, 0.25]),
        # Two fingertips touch. The cube does not yet: as with ant's feet, its friction differs.
        OracleLimit(qvel=2e-3, sensors=0.03, ctrl=0.3, steps=16),
        penetration_m=0.015,
    ),
}
