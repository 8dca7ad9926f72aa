"""What is filmed: positions of worlds over time, and their model, as files. No jax here."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.runs.folder import write_bytes


class Trajectory(NamedTuple):
    """Episodes of some worlds, side by side.

    Attributes:
      qpos: [L + 1, E, nq], or longer where mocap bodies move: see `Env.qpos`.
      lengths: [E] steps of every episode.
      control_dt_s: seconds per step.
    """

    qpos: npt.NDArray[np.float32]
    lengths: npt.NDArray[np.int32]
    control_dt_s: float


def save_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Writes it as a whole or not at all; `load_trajectory` reads it."""
    content = io.BytesIO()
    np.savez(content, **trajectory._asdict())
    write_bytes(path, content.getvalue())


def load_trajectory(path: Path) -> Trajectory:
    """Reads what `save_trajectory` wrote."""
    with np.load(path) as data:
        return Trajectory(data["qpos"], data["lengths"], float(data["control_dt_s"]))


def save_model(path: Path, model: Any) -> None:
    """Writes a `mujoco.MjModel` in MuJoCo's binary format, as a whole or not at all."""
    import mujoco

    content = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    write_bytes(path, content.tobytes())
