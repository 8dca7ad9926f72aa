"""Which camera a film is taken by. No jax here."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gmijax.errors import ConfigError

_DISTANCE = 3.0
"""Of a camera of ours from a robot, in radii of that robot."""


class Camera(NamedTuple):
    """A camera for `mujoco.Renderer.update_scene`.

    Attributes:
      view: index of a camera of the model, -1 for MuJoCo's free one, or a `mujoco.MjvCamera`.
      name: what it is, for people.
    """

    view: Any
    name: str


def check_camera(model: Any, wanted: str | None, task: str) -> None:
    """Raises ConfigError unless the `model` of a task, None for none, has the camera `wanted`."""
    if wanted is None:
        return
    if model is None:
        raise ConfigError(f"camera={wanted}: {task} has no model that could be filmed")
    names = [model.camera(i).name for i in range(model.ncam)]
    if wanted not in names:
        allowed = ", ".join(["null", *filter(None, names)])
        raise ConfigError(f"camera={wanted}: unknown camera of {task}; allowed: {allowed}")


def choose_camera(model: Any, wanted: str | None) -> Camera:
    """The camera `wanted`, else the one that shows most of a robot that moves.

    `track`; else a camera that follows a body; else, if a robot moves freely, a view of ours that
    follows it; else a camera that stands still; else MuJoCo's free one. Never a camera fixed to
    what moves: one in the head of a robot shows the sky.
    """
    import mujoco

    names = [model.camera(i).name for i in range(model.ncam)]
    if wanted is not None:
        return Camera(names.index(wanted), f"camera {wanted}")
    modes = mujoco.mjtCamLight
    tracking = (int(modes.mjCAMLIGHT_TRACK), int(modes.mjCAMLIGHT_TRACKCOM))
    following = [i for i in range(model.ncam) if int(model.cam_mode[i]) in tracking]
    named = [i for i, name in enumerate(names) if name == "track"]
    if following := named or following:
        return Camera(following[0], f"camera {names[following[0]] or following[0]}")
    robot = free_robot(model)
    if robot is not None:
        return Camera(_behind(model, robot), f"a view that follows {model.body(robot).name}")
    still = [i for i in range(model.ncam) if model.body_weldid[model.cam_bodyid[i]] == 0]
    if still:
        return Camera(still[0], f"camera {names[still[0]] or still[0]}")
    return Camera(-1, "MuJoCo's free view")


def free_robot(model: Any) -> int | None:
    """The heaviest body with a free joint and motors below it; without motors, any with the joint.

    None where nothing that the task moves is free: an arm does not leave, and the cube that it
    lifts is no robot.
    """
    import mujoco

    free = model.jnt_bodyid[model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)].tolist()
    moved = _moved_bodies(model)
    with_motors = [body for body in free if any(_is_below(model, one, body) for one in moved)]
    candidates = with_motors if moved else free
    return max(candidates, key=lambda body: model.body_subtreemass[body], default=None)


def _moved_bodies(model: Any) -> set[int]:
    """Bodies that actuators act on."""
    import mujoco

    kinds = mujoco.mjtTrn
    bodies: set[int] = set()
    for kind, (first, _) in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
        if kind in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)):
            bodies.add(int(model.jnt_bodyid[first]))
        elif kind in (int(kinds.mjTRN_SITE), int(kinds.mjTRN_SLIDERCRANK)):
            bodies.add(int(model.site_bodyid[first]))
        elif kind == int(kinds.mjTRN_BODY):
            bodies.add(int(first))
        elif kind == int(kinds.mjTRN_TENDON):
            bodies |= _bodies_of_tendon(model, first)
    return bodies


def _bodies_of_tendon(model: Any, tendon: int) -> set[int]:
    import mujoco

    first, count = model.tendon_adr[tendon], model.tendon_num[tendon]
    joint, site = int(mujoco.mjtWrap.mjWRAP_JOINT), int(mujoco.mjtWrap.mjWRAP_SITE)
    bodies: set[int] = set()
    for at in range(first, first + count):
        if model.wrap_type[at] == joint:
            bodies.add(int(model.jnt_bodyid[model.wrap_objid[at]]))
        elif model.wrap_type[at] == site:
            bodies.add(int(model.site_bodyid[model.wrap_objid[at]]))
    return bodies


def _is_below(model: Any, body: int, root: int) -> bool:
    while body > root:  # Parents come before their children.
        body = int(model.body_parentid[body])
    return body == root


def _behind(model: Any, robot: int) -> Any:
    """A view that follows a body, as far away as suits its size, and not that of the ground."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    own = [i for i in range(model.ngeom) if _is_below(model, int(model.geom_bodyid[i]), robot)]
    reach = (
        np.linalg.norm(data.geom_xpos[own] - data.xpos[robot], axis=-1) + model.geom_rbound[own]
    )
    view = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, view)
    view.type = mujoco.mjtCamera.mjCAMERA_TRACKING
    view.trackbodyid = robot
    view.distance = _DISTANCE * float(max(reach, default=model.stat.extent / 2))
    return view
