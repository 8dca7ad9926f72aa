"""What one environment carries from one control step to the next."""

from __future__ import annotations

from typing import NamedTuple

from gmijax.sim import carried
from gmijax.types import Array


class PhysicsState(NamedTuple):
    """What one environment must remember between steps.

    Attributes:
      qpos: [nq] float32, joint positions.
      qvel: [nv] float32, joint velocities.
      qacc_warmstart: [nv] float32, the last acceleration, where the solver starts from.
      overflow: [2] bool, which buffers of `OVERFLOWS` were too small in the last control step;
        None with MJX-JAX, whose buffers hold all that can ever be.

    The others are `gmijax.sim.carried.NAMES`, as in MuJoCo's data; None where an environment does
    not carry them. `_replace` drives them: a push, the path of a mocap body.

    Attributes:
      act: [na] float32, activations; carried if the model has any.
      time: [] float32, seconds; carried if a sensor shows it, or with `history`.
      history: [nhistory] float32, samples of delayed actuators and sensors; carried if any are.
      mocap_pos: [nmocap, 3] float32, in metres.
      mocap_quat: [nmocap, 4] float32.
      eq_active: [neq] bool, which equality constraints hold.
      qfrc_applied: [nv] float32, forces on joints.
      xfrc_applied: [nbody, 6] float32, forces and torques on bodies, in the world.
    """

    qpos: Array
    qvel: Array
    qacc_warmstart: Array
    overflow: Array | None = None
    act: Array | None = None
    time: Array | None = None
    history: Array | None = None
    mocap_pos: Array | None = None
    mocap_quat: Array | None = None
    eq_active: Array | None = None
    qfrc_applied: Array | None = None
    xfrc_applied: Array | None = None

    def carried(self) -> dict[str, Array]:
        """What this environment carries of `gmijax.sim.carried.NAMES`, by name."""
        values = {name: getattr(self, name) for name in carried.NAMES}
        return {name: value for name, value in values.items() if value is not None}
