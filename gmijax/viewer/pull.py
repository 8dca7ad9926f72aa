"""The spring by which the mouse pulls a body, MuJoCo's own. No jax here."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt


class Pull:
    """A spring from a point of a body to the pointer.

    Args:
      model: a `mujoco.MjModel`.
      data: the `mujoco.MjData` that is stepped.
      now: another one after `mj_fwdPosition` of the pose in which the body was grabbed; `data` has
        no inertias at the start of an episode.
      body: that is pulled.
      grabbed: [3] the point that was taken hold of, in the world, m.
    """

    def __init__(
        self, model: Any, data: Any, now: Any, body: int, grabbed: npt.NDArray[Any]
    ) -> None:
        self._model, self._data = model, data
        self._spring = mujoco.MjvPerturb()
        self._spring.select = body
        self._spring.active = int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
        self._spring.scale = 1.0
        self._spring.localpos = now.xmat[body].reshape(3, 3).T @ (grabbed - now.xpos[body])
        self._spring.localmass = _mass_at(model, now, body, grabbed)
        self.pointer = grabbed

    @property
    def body(self) -> int:
        """The body that is pulled."""
        return self._spring.select

    @property
    def grabbed(self) -> npt.NDArray[Any]:
        """[3] where the point of the body is now, m."""
        frame = self._data.xmat[self.body].reshape(3, 3)
        return self._data.xpos[self.body] + frame @ self._spring.localpos

    def apply(self) -> None:
        """Writes the spring's force and torque into `xfrc_applied`."""
        self._spring.refselpos = self.pointer
        mujoco.mjv_applyPerturbForce(self._model, self._data, self._spring)


def _mass_at(model: Any, data: Any, body: int, point: npt.NDArray[Any]) -> float:
    """What a force at a point of a body has to move, kg, as MuJoCo's viewer reckons it."""
    jacobian, solved = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, point, body)
    mujoco.mj_solveM(model, data, solved, jacobian)
    return 3.0 / max(float(np.trace(jacobian @ solved.T)), mujoco.mjMINVAL)
