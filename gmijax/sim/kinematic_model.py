"""A model of MJX-JAX that knows bodies, joints and masses, for environments that others step."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
from mujoco import mjx


class _Kinematic:
    """An `mjModel` in which nothing collides, pulls or senses; all numbers are its own."""

    def __init__(self, mj_model: mujoco.MjModel) -> None:
        self._mj_model = mj_model
        self.npair = self.nflex = 0
        self.geom_contype = self.geom_conaffinity = np.zeros_like(mj_model.geom_contype)
        # Types that MJX-JAX has; what they are types of is never computed.
        self.sensor_type = np.full_like(mj_model.sensor_type, mujoco.mjtSensor.mjSENS_CLOCK)
        self.wrap_type = np.full_like(mj_model.wrap_type, mujoco.mjtWrap.mjWRAP_JOINT)
        for name in ("trntype", "dyntype", "gaintype", "biastype"):
            setattr(self, f"actuator_{name}", np.zeros(mj_model.nu, np.int32))
        self.eq_type = np.zeros_like(mj_model.eq_type)
        self.opt = copy.copy(mj_model.opt)
        self.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        self.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
        self.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        self.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
        self.opt.enableflags = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._mj_model, name)


def kinematic_model(mj_model: mujoco.MjModel) -> mjx.Model:
    """All leaves of the model that are drawn, and what `mjx.kinematics` reads.

    MJX-JAX must not be asked whether it could simulate a model that it will not simulate.
    """
    plain: Any = _Kinematic(mj_model)
    return mjx.put_model(plain, impl="jax")
