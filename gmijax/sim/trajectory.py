"""What is filmed: positions of environments over time, and their model, as files. No jax here.

Films show environments by quantiles of their returns: the first ones may all have failed, or none.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.runs.folder import write_bytes


class Trajectory(NamedTuple):
    """Episodes of some environments, side by side.

    Attributes:
      qpos: [L + 1, E, nq], or longer where mocap bodies move: see `Env.qpos`; at its end
        `Env.command`, if there is one.
      lengths: [E] steps of every episode.
      control_dt_s: seconds per step.
      labels: what to write into the picture of every environment.
      lines: what to write below all of them.
    """

    qpos: npt.NDArray[np.float32]
    lengths: npt.NDArray[np.int32]
    control_dt_s: float
    labels: Sequence[str] = ()
    lines: Sequence[str] = ()


MOST_RECORDED = 64
"""Environments of which positions are kept, for a film to choose from."""


def chosen(
    qpos: npt.NDArray[np.float32],
    lengths: npt.NDArray[np.int32],
    returns: npt.NDArray[Any],
    control_dt_s: float,
    *,
    count: int,
    title: str,
    command: str,
) -> Trajectory:
    """The episodes that a film shows: `count` of N, evenly spread over the order of returns.

    Of four these are the quantiles 1/8, 3/8, 5/8 and 7/8, and one is the median.

    Args:
      qpos: [L + 1, N, nq], or longer.
      lengths: [N], or those of more episodes, which were not recorded.
      returns: the same.
      control_dt_s: seconds per step.
      count: how many are shown.
      title: what is filmed, for the line that names the median.
      command: what the user may type to see it.
    """
    num_recorded = qpos.shape[1]
    lengths, returns = lengths[:num_recorded], returns[:num_recorded]
    order = np.argsort(returns, kind="stable")
    at = (np.arange(count) + 0.5) / count * len(order)
    indices = order[at.astype(int)]
    labels = [
        f"return {rounded(float(returns[index]))} (rank {len(order) - int(nth)} of {len(order)})"
        for nth, index in zip(at, indices, strict=True)
    ]
    median = f"median return {rounded(float(np.median(returns)))} of {len(order)} episodes"
    longest = int(lengths[indices].max())
    return Trajectory(
        qpos[: longest + 1, indices],
        lengths[indices],
        control_dt_s,
        labels,
        (f"{title}: {median}", f"$ {command}"),
    )


def rounded(value: float) -> str:
    """A return for people: three digits, or all before the point.

    Examples:
      >>> rounded(12345.6), rounded(1.2345)
      ('12,346', '1.23')
    """
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def save_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Writes it as a whole or not at all; `load_trajectory` reads it."""
    content = io.BytesIO()
    texts = {name: np.array(getattr(trajectory, name), np.str_) for name in ("labels", "lines")}
    np.savez(content, **{**trajectory._asdict(), **texts})
    write_bytes(path, content.getvalue())


def load_trajectory(path: Path) -> Trajectory:
    """Reads what `save_trajectory` wrote."""
    with np.load(path) as data:
        texts = (tuple(map(str, data[name])) for name in ("labels", "lines"))
        return Trajectory(data["qpos"], data["lengths"], float(data["control_dt_s"]), *texts)


def save_model(path: Path, model: Any) -> None:
    """Writes a `mujoco.MjModel` in MuJoCo's binary format, as a whole or not at all."""
    import mujoco

    content = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    write_bytes(path, content.tobytes())
