"""Main of the evaluating child of `gmijax.play`, started by `gmijax.deploy.playing` only.

Restores a policy, runs episodes with it, and writes their returns and a trajectory to film.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gmijax.config import EnvConfig, PlayConfig
from gmijax.config.schema import from_dict
from gmijax.control.console import nearby
from gmijax.player.joystick import Robot, robot_of
from gmijax.player.outcome import Episodes, summarise
from gmijax.player.walking import NUM_ENVS
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import PlayPaths, read_json, write_json
from gmijax.runs.saved_config import trained_config
from gmijax.supervise.child import ChildLink, run_gmi

if TYPE_CHECKING:
    from gmijax.learning.learner import Learner, TrainState
    from gmijax.sim.interface import Env


def _run(link: ChildLink) -> None:
    config = from_dict(PlayConfig, read_json(link.run.config))
    checkpoint = Path(str(config.checkpoint))
    env_config, algo = trained_config(checkpoint)
    env_config = config.run.task(env_config)
    # jax starts here, in the environment that the plan prepared.
    import jax

    from gmijax.learning.learner import make_learner
    from gmijax.learning.start import saved_state
    from gmijax.sim.camera import check_camera, choose_camera
    from gmijax.sim.randomize import make_envs

    impl = _impl(config, checkpoint, env_config)
    # At its full range: what was learnt in the end is what counts.
    played = dataclasses.replace(env_config, randomize=config.randomize, curriculum="off")
    env = make_envs(played, impl, seed=config.seed, first_env=0, num_envs=config.num_envs)
    check_camera(env.mj_model, config.camera, env.spec.name)
    learner = make_learner(env.spec, algo)
    state = saved_state(checkpoint, learner, env.spec.obs_size)
    episodes = _episodes(config, env, learner, state, link)
    paths = PlayPaths(link.run.root)
    env_steps = CheckpointMeta.read(checkpoint).env_steps
    _write_trajectory(paths, env, episodes, config, env_steps)
    device = jax.local_devices()[0]
    camera = None if env.mj_model is None else choose_camera(env.mj_model, config.camera).name
    about: dict[str, Any] = {
        "impl": impl,
        "device": f"{device.platform}: {device.device_kind}",
        "camera": camera,
    }
    outcome = summarise(config, env.spec.name, env_steps, episodes)
    # After the trajectory, so that a reader that sees this file finds that one complete. Before
    # the walking test, which may fail.
    write_json(paths.returns, {**outcome, **about})
    if (robot := robot_of(env_config)) is not None:
        about["walking"] = _walk(config, env_config, robot, impl, link, learner, state)
        write_json(paths.returns, {**outcome, **about})


def _episodes(
    config: PlayConfig, env: Env, learner: Learner, state: TrainState, link: ChildLink
) -> Episodes:
    from gmijax.learning.episodes import EpisodeOptions, run_episodes
    from gmijax.sim.trajectory import MOST_RECORDED

    link.beat("compiling", 0)
    options = EpisodeOptions(
        num_envs=config.num_envs,
        num_shown=min(config.num_envs, max(config.num_filmed, MOST_RECORDED)),
        seed=config.seed,
        deterministic=config.deterministic,
        max_steps=config.max_steps,
    )
    return run_episodes(env, learner, state, options, lambda chunks: link.beat("running", chunks))


def _walk(
    config: PlayConfig,
    env_config: EnvConfig,
    robot: Robot,
    impl: str,
    link: ChildLink,
    learner: Learner,
    state: TrainState,
) -> dict[str, Any] | None:
    """What the walking test found, None without one."""
    import jax

    num_envs = config.walking_envs
    if num_envs is None:
        num_envs = 0 if jax.default_backend() == "cpu" else NUM_ENVS
    if num_envs == 0 or env_config.action_repeat != 1:
        return None
    from gmijax.learning.walking import WalkingTest, act_of, walking_env
    from gmijax.sim.robots import changed_settings

    link.beat("compiling", 0)
    env = walking_env(env_config, robot, impl, num_envs)
    test = WalkingTest(env, robot, act_of(learner), num_envs=num_envs, seed=config.seed)
    test.compile(state)
    walk = test.run(state, lambda chunks: link.beat("running", chunks))
    return walk._replace(settings=changed_settings(env_config)).as_json()


def _impl(config: PlayConfig, checkpoint: Path, env_config: EnvConfig) -> str:
    """The MJX to play with; prints why."""
    import jax

    from gmijax.sim.impl import choose_impl, impl_of_policy

    wanted = impl_of_policy(config.physics.impl, CheckpointMeta.read(checkpoint).impl)
    impl, why = choose_impl(wanted, jax.default_backend(), env_config.label)
    sys.stdout.write(f"physics.impl={impl}: {why}\n")
    return impl


def _write_trajectory(
    paths: PlayPaths, env: Env, episodes: Episodes, config: PlayConfig, env_steps: int
) -> None:
    from gmijax.sim.trajectory import save_model, save_trajectory

    if env.mj_model is None:  # The controller sees that there is nothing to film.
        return
    save_model(paths.model, env.mj_model)
    run = nearby(Path(str(config.run.dir)))
    trajectory = episodes.filmed(
        env.spec.control_dt_s,
        count=config.num_filmed,
        title=f"{env.spec.name} after {env_steps:,} env steps",
        command=f"gmijax play run.dir={run} checkpoint={env_steps}{config.film_overrides()}",
    )
    save_trajectory(paths.trajectory, trajectory)


if __name__ == "__main__":
    sys.exit(run_gmi(_run))
