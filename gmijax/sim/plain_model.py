"""The same model in words that every implementation of MJX understands."""

from __future__ import annotations

import copy
from typing import Any, TypeAlias

import mujoco
import numpy as np

Model: TypeAlias = mujoco.MjModel

_ENABLE, _DISABLE = mujoco.mjtEnableBit, mujoco.mjtDisableBit
_OF_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_SCALAR = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)

WITHOUT_EFFECT = (
    (
        "enableflags",
        _ENABLE.mjENBL_ENERGY | _ENABLE.mjENBL_FWDINV | _ENABLE.mjENBL_INVDISCRETE,
    ),
    ("disableflags", _DISABLE.mjDSBL_MIDPHASE | _DISABLE.mjDSBL_AUTORESET),
)
"""Flags that change nothing in a step of MJX, and that it may refuse."""


def plain(mj_model: Model) -> Model:
    """An equal model in words that MJX understands; itself where nothing has to be rewritten.

    Flags of `WITHOUT_EFFECT` are cleared. Damping and armature of actuators become those of the
    joints and tendons that they move, times their gears squared.
    """
    flags = any(getattr(mj_model.opt, name) & bits for name, bits in WITHOUT_EFFECT)
    resisting = np.flatnonzero(_resistance(mj_model))
    if not flags and not len(resisting):
        return mj_model
    same, targets = copy.copy(mj_model), _targets(mj_model)
    for name, bits in WITHOUT_EFFECT:
        setattr(same.opt, name, getattr(same.opt, name) & ~bits)
    for k in resisting:
        gear = same.actuator_gear[same.actuator_outadr[k], 0]
        of = "dof" if targets[k] < same.nv else "tendon"
        index = targets[k] - (0 if of == "dof" else same.nv)
        for kind in ("damping", "dampingpoly", "armature"):
            own = getattr(same, f"actuator_{kind}")
            if targets[k] >= 0:  # MuJoCo has none of balls and free bodies.
                getattr(same, f"{of}_{kind}")[index] += own[k] * gear**2
            own[k] = 0.0
    return same


def _resistance(m: Model) -> Any:
    """[nactuator] bool: whether an actuator has damping or armature of its own."""
    polynomials = (m.actuator_dampingpoly != 0).any(axis=1)
    return (m.actuator_damping != 0) | polynomials | (m.actuator_armature != 0)


def _targets(m: Model) -> Any:
    """[nactuator] what actuators move by their gears: a dof, nv plus a tendon, -1 for others."""
    numbers = m.actuator_trnid[:, 0]
    if not m.njnt:
        return np.full(m.nactuator, -1)
    joints = np.clip(numbers, 0, m.njnt - 1)
    of_joint = np.isin(m.actuator_trntype, _OF_JOINTS) & np.isin(m.jnt_type[joints], _SCALAR)
    of_tendon = m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    return np.where(of_joint, m.jnt_dofadr[joints], np.where(of_tendon, m.nv + numbers, -1))
