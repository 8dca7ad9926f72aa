"""The models of Playground's joystick tasks, from the files of the package. Imports no jax."""

from __future__ import annotations

from typing import Any, Literal

import mujoco

from gmijax.config.env import ROBOTS as NAMES
from gmijax.errors import ConfigError
from gmijax.player.joystick import Robot
from gmijax.sim.robot_models import model_folder, models_of, playground_folder


def joystick_model(robot: Robot, terrain: Literal["flat", "rough"]) -> Any:
    """The `mujoco.MjModel` of a robot's task, as its file has it.

    Raises:
      ConfigError: Playground or the robot's meshes are not installed, or no such terrain.
    """
    if (package := playground_folder()) is None:
        raise ConfigError(
            "the models need the package mujoco_playground (pip install 'gmijax[playground]')"
        )
    xmls = package / "_src" / "locomotion" / robot.name / "xmls"
    if terrain == "rough" and f"{robot.name}_rough" not in NAMES:
        raise ConfigError(f"terrain=rough: {robot.name} has none; allowed: flat")
    scene = xmls / f"scene_mjx_feetonly_{terrain}_terrain.xml"
    folder = model_folder(*models_of(NAMES[robot.name]))
    files = [
        path
        for parent, pattern in ((xmls, "*.xml"), (xmls / "assets", "*"), (folder, "*.xml"))
        for path in parent.glob(pattern)
    ]
    files += (folder / "assets").glob("*")
    assets = {path.name: path.read_bytes() for path in files if path.is_file()}
    model = mujoco.MjModel.from_xml_string(scene.read_text(), assets=assets)
    if model.nhfield:
        # With MuJoCo's own collision detector a small foot that hits a height field sinks into it
        # and stays there (MuJoCo 3.17, github.com/google-deepmind/mujoco/issues/2883). With
        # libccd it does not, nor does it in MJX, where policies are trained.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    return model
