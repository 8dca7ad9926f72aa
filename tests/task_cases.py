"""What the contract test must be told of every task: a way to die, and how near C MuJoCo it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp


class OracleLimit(NamedTuple):
    """Largest allowed difference from C MuJoCo in one step, and the controls that it holds for.

    Attributes:
      qvel: rad/s or m/s, after one physics step.
      sensors: N or N m.
      ctrl: controls are drawn from -ctrl to ctrl.
      steps: length of the trajectory.
    """

    qvel: float
    sensors: float
    ctrl: float
    steps: int


class TaskCase(NamedTuple):
    """One task.

    Attributes:
      hazard: moves world 0 of `qpos` [N, nq] to where the next step ends the episode; None for a
        task that only time ends.
      oracle: how near to C MuJoCo one physics step must be.
    """

    hazard: Callable[[jax.Array], jax.Array] | None
    oracle: OracleLimit


def lowered_ant(qpos: jax.Array) -> jax.Array:
    return qpos.at[0, 2].set(0.25)


def dropped_ball(qpos: jax.Array) -> jax.Array:
    return qpos.at[0, 13:16].set(jnp.array([2.0, 0.0, 0.1]))


CASES = {
    "ant": TaskCase(
        lowered_ant,
        # The trajectory ends before the first foot touches the floor: C turns the edges of that
        # contact's friction pyramid by another angle about the normal than MJX 3.17 does.
        OracleLimit(qvel=1e-4, sensors=1e-3, ctrl=0.3, steps=7),
    ),
    "ball_balance": TaskCase(
        dropped_ball,
        # MuJoCo 4 in C predicts how a `connect` will move with the bodies' rotation (the term
        # with the Jacobian's time derivative), MJX 3.17 does not: they part with the legs' speed
        # squared. The ball lands on the tray in step 84.
        OracleLimit(qvel=0.02, sensors=4.0, ctrl=0.02, steps=96),
    ),
}
