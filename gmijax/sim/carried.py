"""What may be carried between control steps beside positions, velocities and the warm start.

MuJoCo's data have more that outlives a step. An environment carries what its model cannot do
without, and what a task sets at a start; all else costs nothing.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from gmijax.errors import ConfigError
from gmijax.types import Array

NAMES = (
    *("act", "time", "history"),
    *("mocap_pos", "mocap_quat", "eq_active", "qfrc_applied", "xfrc_applied"),
)
"""Names as in MuJoCo's data. Physics moves the first three, a task all others."""


def at_start(mj_model: mujoco.MjModel, given: Mapping[str, Array]) -> dict[str, Array]:
    """What an environment carries that starts with what is `given`.

    Raises:
      ConfigError: a name or a shape that the model does not have.
    """
    shapes = _shapes(mj_model)
    for name, value in given.items():
        if name not in shapes:
            known = ", ".join(shapes)
            raise ConfigError(f"sim.start: no {name} can be carried; allowed: {known}")
        if np.shape(value) != shapes[name]:
            raise ConfigError(f"sim.start: {name} has shape {np.shape(value)}, not {shapes[name]}")
    missing = [name for name in needed(mj_model) if name not in given]
    fresh = mujoco.MjData(mj_model) if missing else None
    first = {name: getattr(fresh, name) for name in missing}
    return {name: _typed(name, value) for name, value in (first | dict(given)).items()}


def _typed(name: str, value: Array) -> Array:
    import jax.numpy as jnp

    return jnp.asarray(value, bool if name == "eq_active" else jnp.float32)


def needed(mj_model: mujoco.MjModel) -> tuple[str, ...]:
    """What no task could do without: activations, delayed samples, and the time if it is seen."""
    has_clock = (mj_model.sensor_type == mujoco.mjtSensor.mjSENS_CLOCK).any()
    has_history = mj_model.nhistory > 0
    wanted = {"act": mj_model.na > 0, "time": has_clock or has_history, "history": has_history}
    return tuple(name for name, is_wanted in wanted.items() if is_wanted)


def _shapes(mj_model: mujoco.MjModel) -> dict[str, tuple[int, ...]]:
    shapes = (
        (mj_model.na,),
        (),
        (mj_model.nhistory,),
        (mj_model.nmocap, 3),
        (mj_model.nmocap, 4),
        (mj_model.neq,),
        (mj_model.nv,),
        (mj_model.nbody, 6),
    )
    return dict(zip(NAMES, shapes, strict=True))
