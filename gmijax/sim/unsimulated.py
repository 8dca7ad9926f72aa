"""Parts of a model that an implementation of MJX reads over, or carries nothing for, by name.

MJX refuses what it does not have, mostly. What it copies and never reads, it simulates as if it
were not there. `PARTS` has these, and those that MJX refuses in words of C.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import mujoco
import numpy as np

from gmijax.errors import ConfigError
from gmijax.sim.impl import Impl

Model: TypeAlias = mujoco.MjModel

_BOTH: tuple[Impl, ...] = ("jax", "warp")
_JAX: tuple[Impl, ...] = ("jax",)
_ENABLE, _DISABLE = mujoco.mjtEnableBit, mujoco.mjtDisableBit
_SENSOR, _GEOM = mujoco.mjtSensor, mujoco.mjtGeom


class Part(NamedTuple):
    """A part of a model.

    Attributes:
      impls: implementations that do not simulate it.
      name: in the words of the model's XML.
      is_in: whether a model has it and it matters there.
      instead: what is allowed.
    """

    impls: tuple[Impl, ...]
    name: str
    is_in: Callable[[Model], Any]
    instead: str


def refuse_parts(mj_model: Model, impl: Impl) -> None:
    """Raises ConfigError with the first of `PARTS` that is in the model."""
    for part in PARTS:
        if impl in part.impls and part.is_in(mj_model):
            raise ConfigError(
                f"model: {part.name}, which {FULL_NAMES[impl]} (physics.impl={impl}) does not "
                f"simulate; allowed: {part.instead}"
            )


def refuse_idle_sensors(mj_model: Model, contacts: int, rows: int) -> None:
    """Raises ConfigError for sensors that MJX-JAX cannot fill.

    Args:
      mj_model: the model.
      contacts: all that MJX-JAX can make; without any it fails over sensors of them.
      rows: of constraints; without any it leaves sensors of forces at zero.
    """
    touches = np.isin(mj_model.sensor_type, (_SENSOR.mjSENS_TOUCH, _SENSOR.mjSENS_CONTACT))
    needs = mj_model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC
    for idle, lack, instead in (
        (touches & (contacts == 0), "geoms that may collide", "at least one pair of them"),
        (
            needs & (rows == 0),
            "limits, contacts, friction and equalities",
            "one of these, such as a wide range of a joint",
        ),
    ):
        if idle.any():
            first = mj_model.sensor(int(np.flatnonzero(idle)[0]))
            kind = mujoco.mjtSensor(int(first.type[0])).name.removeprefix("mjSENS_").lower()
            raise ConfigError(
                f"model: a sensor of forces ({first.name or kind}) in a model without {lack}, "
                f"which MJX-JAX (physics.impl=jax) cannot fill; allowed: {instead}"
            )


FULL_NAMES: dict[Impl, str] = {"jax": "MJX-JAX", "warp": "MuJoCo Warp"}


def _enables(bit: mujoco.mjtEnableBit) -> Callable[[Model], bool]:
    return lambda m: bool(m.opt.enableflags & bit)


def _senses(*types: mujoco.mjtSensor) -> Callable[[Model], Any]:
    return lambda m: np.isin(m.sensor_type, types).any()


def _any(*names: str) -> Callable[[Model], bool]:
    return lambda m: any(bool(np.any(getattr(m, name))) for name in names)


def _disabled_actuators(m: Model) -> Any:
    groups = m.actuator_group
    in_range = (groups >= 0) & (groups < 31)
    return (in_range & (m.opt.disableactuator >> np.clip(groups, 0, 30) & 1)).any()


def _ellipsoid_fluid(m: Model) -> Any:
    has_medium = m.opt.density > 0 or m.opt.viscosity > 0
    return has_medium and (m.geom_fluid.reshape(m.ngeom, -1)[:, 0] > 0).any()


def _one_of_spring_and_damper(m: Model) -> Any:
    """Without either MJX-JAX has no passive forces at all, without both MuJoCo has none."""
    bits = m.opt.disableflags & (_DISABLE.mjDSBL_SPRING | _DISABLE.mjDSBL_DAMPER)
    others = m.ngravcomp or m.opt.density > 0 or m.opt.viscosity > 0
    if bits == _DISABLE.mjDSBL_SPRING:
        return others or _any("dof_damping", "tendon_damping")(m)
    return bits == _DISABLE.mjDSBL_DAMPER and (
        others or _any("jnt_stiffness", "tendon_stiffness")(m)
    )


def _sensors_of(m: Model, kind: mujoco.mjtSensor) -> Any:
    return np.flatnonzero(m.sensor_type == kind)


def _ranges_from_cameras(m: Model) -> Any:
    found = _sensors_of(m, _SENSOR.mjSENS_RANGEFINDER)
    site = m.sensor_objtype[found] == mujoco.mjtObj.mjOBJ_SITE
    return (~site | (m.sensor_dim[found] != 1)).any()


def _ranges_of_unseen_geoms(m: Model) -> Any:
    """A range finder sees no geoms of its own body."""
    unseen = np.isin(m.geom_type, (_GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_HFIELD, _GEOM.mjGEOM_SDF))
    found = _sensors_of(m, _SENSOR.mjSENS_RANGEFINDER)
    sites = found[m.sensor_objtype[found] == mujoco.mjtObj.mjOBJ_SITE]
    own = m.site_bodyid[m.sensor_objid[sites]]
    return (m.geom_bodyid[unseen][:, None] != own).any()


def _ranges_without_materials(m: Model) -> Any:
    return len(_sensors_of(m, _SENSOR.mjSENS_RANGEFINDER)) and not m.nmat


def _touch_in_cylinders(m: Model) -> Any:
    sites = m.sensor_objid[_sensors_of(m, _SENSOR.mjSENS_TOUCH)]
    return (m.site_type[sites] == _GEOM.mjGEOM_CYLINDER).any()


PARTS: tuple[Part, ...] = (
    Part(_BOTH, "plugins", lambda m: m.nplugin, "none"),
    Part(_JAX, "delay of actuators or sensors", lambda m: m.nhistory, "none"),
    Part(_BOTH, 'flag sleep="enable"', _enables(_ENABLE.mjENBL_SLEEP), "disable"),
    Part(_BOTH, 'flag override="enable"', _enables(_ENABLE.mjENBL_OVERRIDE), "disable"),
    Part(_BOTH, 'flag diagexact="enable"', _enables(_ENABLE.mjENBL_DIAGEXACT), "disable"),
    Part(
        _BOTH,
        'solver="PGS"',
        lambda m: m.opt.solver == mujoco.mjtSolver.mjSOL_PGS,
        'solver="Newton" or "CG"',
    ),
    Part(
        _BOTH,
        "actuatorgroupdisable of actuators that are there",
        _disabled_actuators,
        "to leave these actuators out",
    ),
    Part(_JAX, "rangefinders with a camera or data of their own", _ranges_from_cameras, "a site"),
    Part(_JAX, "no joint", lambda m: not m.nv, "at least one"),
    Part(
        _JAX,
        'integrator="implicit" or "discrete"',
        lambda m: (
            m.opt.integrator
            in (mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_DISCRETE)
        ),
        'integrator="implicitfast", "Euler" or "RK4"',
    ),
    Part(
        _JAX,
        "noslip_iterations",
        lambda m: m.opt.noslip_iterations > 0,
        'noslip_iterations="0" (a larger impratio with cone="elliptic" slips less too)',
    ),
    Part(
        _JAX,
        'fluidshape="ellipsoid" in a medium',
        _ellipsoid_fluid,
        'fluidshape="none", or density="0" viscosity="0"',
    ),
    Part(
        _JAX,
        'only one of the flags spring="disable" and damper="disable"',
        _one_of_spring_and_damper,
        "both or none",
    ),
    Part(
        _JAX,
        "polynomials of stiffness or damping",
        _any("jnt_stiffnesspoly", "dof_dampingpoly", "tendon_stiffnesspoly", "tendon_dampingpoly"),
        "one number",
    ),
    Part(
        _JAX,
        'actearly="true"',
        lambda m: (m.actuator_actearly & (m.actuator_actnum > 0)).any(),
        'actearly="false"',
    ),
    Part(_JAX, "adhesion of geoms or pairs", _any("geom_adhesion", "pair_adhesion"), "0"),
    Part(_JAX, "surfacevel of geoms", _any("geom_surfacevel"), "0"),
    Part(_JAX, "tactile sensors", _senses(_SENSOR.mjSENS_TACTILE), "touch or contact"),
    Part(
        _JAX,
        "rangefinders beside cylinders, height fields or SDFs, which they do not see",
        _ranges_of_unseen_geoms,
        "planes, spheres, capsules, ellipsoids, boxes and meshes",
    ),
    Part(
        _JAX,
        "rangefinders in a model without any material",
        _ranges_without_materials,
        "to give a geom a material",
    ),
    Part(_JAX, "touch sensors in a cylinder", _touch_in_cylinders, "a site of another type"),
)
"""What is refused. A unit test shows for each that MuJoCo in C moves otherwise."""
