"""Main of the child of `gmijax.export`, started by `gmijax.deploy.exporting` only."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gmijax.config import EnvConfig, ExportConfig
from gmijax.config.schema import from_dict
from gmijax.player.deployment import deployment_of
from gmijax.player.joystick import part_sizes, robot_of, with_own_pushes
from gmijax.runs.folder import ExportPaths, read_json, write_bytes, write_json
from gmijax.runs.saved_config import trained_config
from gmijax.sim.robots import changed_settings
from gmijax.supervise.child import ChildLink, run_gmi

if TYPE_CHECKING:
    from gmijax.sim.interface import Env


def _run(link: ChildLink) -> None:
    config = from_dict(ExportConfig, read_json(link.run.config))
    checkpoint = Path(str(config.checkpoint))
    env_config, _ = trained_config(checkpoint)
    env_config = dataclasses.replace(config.run.task(env_config), randomize="off")
    # jax starts here, in the environment that the plan prepared.
    from gmijax.deploy.files import onnx_content, stablehlo_content
    from gmijax.deploy.trained import trained_policy
    from gmijax.sim.randomize import make_envs

    link.beat("running", 0)
    policy = trained_policy(checkpoint)
    # Only asked for names: nothing is simulated.
    env = make_envs(env_config, "jax", seed=0, first_env=0, num_envs=1)
    metadata = {**policy.metadata, **names_of(env), **_robot(env_config, env, policy.obs_size)}
    paths = ExportPaths(link.run.root)
    if config.format in ("onnx", "all"):
        write_bytes(paths.onnx, onnx_content(policy, metadata))
    if config.format in ("stablehlo", "all"):
        write_bytes(paths.stablehlo, stablehlo_content(policy))
    # Written last: a reader that sees it finds the others.
    write_json(paths.metadata, metadata)


def names_of(env: Env) -> dict[str, Any]:
    """What only the environment knows of its policies: what they see and drive, and how often.

    Actions have names where the model has one actuator for each; joints are in the order of
    `qpos`. None: not known.
    """
    spec, model = env.spec, env.mj_model
    seen = spec.actor_obs_size or spec.obs_size
    num_values = sum(length for _, length in spec.obs_terms)
    actuators = [] if model is None else [model.actuator(i).name for i in range(model.nu)]
    joints = [] if model is None else [model.joint(i).name for i in range(model.njnt)]
    return {
        "control_dt_s": spec.control_dt_s,
        "obs_terms": list(map(list, spec.obs_terms)) if num_values == seen else None,
        "action_names": actuators if len(actuators) == spec.action_size else None,
        "joint_names": joints or None,
    }


def _robot(config: EnvConfig, env: Env, obs_size: int) -> dict[str, Any]:
    """What a robot must know of its policy; nothing for another task.

    Nor for a policy that sees what no robot does, as a teacher may.
    """
    robot = robot_of(config)
    if robot is None:
        return {}
    from gmijax.sim.adapters.playground import configuration

    parts = part_sizes(robot, env.spec.action_size)
    if obs_size != config.history * sum(length for _, length in parts):
        return {}
    # The exported policy is tested as the trained one: with the task's own pushes.
    settings = with_own_pushes(config.settings)
    task = deployment_of(robot, env.mj_model, configuration(str(config.name), settings))
    return {
        "obs_terms": list(map(list, parts)) * config.history,
        "robot": {
            **task,
            "history": config.history,
            "action_repeat": config.action_repeat,
            "settings": changed_settings(config),
        },
    }


if __name__ == "__main__":
    sys.exit(run_gmi(_run))
