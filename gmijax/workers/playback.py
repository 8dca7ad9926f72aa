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
from gmijax.errors import ConfigError
from gmijax.runs.folder import PlayPaths, read_json, write_json
from gmijax.runs.resume import CheckpointMeta
from gmijax.runs.saved_config import trained_config
from gmijax.supervise.child import ChildLink, run_gmi

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from gmijax.learning.episodes import Episodes
    from gmijax.sim.interface import Env


def _run(link: ChildLink) -> None:
    config = from_dict(PlayConfig, read_json(link.run.config))
    checkpoint = Path(str(config.checkpoint))
    env_config, algo = trained_config(checkpoint)
    env_config = config.run.task(env_config)
    # jax starts here, in the environment that the plan prepared.
    import jax

    from gmijax.learning.checkpoint import restore_learner
    from gmijax.learning.episodes import Options, run_episodes
    from gmijax.learning.learner import init_learner, make_learner
    from gmijax.sim.camera import choose_camera
    from gmijax.sim.randomize import make_worlds
    from gmijax.sim.trajectory import MOST_RECORDED

    impl = _impl(config, checkpoint, env_config)
    # At its full range: what was learnt in the end is what counts.
    played = dataclasses.replace(env_config, randomize=config.randomize, curriculum="off")
    env = make_worlds(played, impl, seed=config.seed, first_env=0, num_envs=config.num_envs)
    _check_camera(config.camera, env)
    learner = make_learner(env.spec, algo)
    state = jax.jit(lambda key: init_learner(learner, env.spec.obs_size, key))(jax.random.key(0))
    state = restore_learner(checkpoint, state)
    link.beat("compiling", 0)
    episodes = run_episodes(
        env,
        learner,
        state,
        Options(
            num_envs=config.num_envs,
            num_shown=min(config.num_envs, max(config.num_filmed, MOST_RECORDED)),
            seed=config.seed,
            deterministic=config.deterministic,
            max_steps=config.max_steps,
        ),
        lambda chunks: link.beat("running", chunks),
    )
    paths = PlayPaths(link.run.root)
    _write_trajectory(paths, env, episodes, config)
    device = jax.local_devices()[0]
    camera = None if env.mj_model is None else choose_camera(env.mj_model, config.camera).name
    about = {
        "impl": impl,
        "device": f"{device.platform}: {device.device_kind}",
        "camera": camera,
    }
    # Written last: whoever sees it finds the trajectory complete.
    write_json(paths.returns, {**summarise(config, env.spec.name, episodes), **about})


def _impl(config: PlayConfig, checkpoint: Path, env_config: EnvConfig) -> str:
    """The MJX to play with; says why."""
    import jax

    from gmijax.sim.impl import choose_impl

    wanted = config.physics.impl
    if wanted == "auto" and CheckpointMeta.read(checkpoint).impl == "jax":
        # A policy may depend on what it was trained with.
        wanted = "jax"
    impl, why = choose_impl(wanted, jax.default_backend(), env_config.label)
    sys.stdout.write(f"physics.impl={impl}: {why}\n")
    return impl


def summarise(config: PlayConfig, env_name: str, episodes: Episodes) -> dict[str, Any]:
    """The content of `returns.json`, without the device."""
    checkpoint = Path(str(config.checkpoint))
    ended = episodes.terminated | episodes.truncated
    return {
        "env": env_name,
        "checkpoint": str(checkpoint),
        "env_steps": CheckpointMeta.read(checkpoint).env_steps,
        "num_envs": config.num_envs,
        "seed": config.seed,
        "deterministic": config.deterministic,
        "max_steps": config.max_steps,
        "return": statistics(episodes.returns),
        "length": statistics(episodes.lengths),
        "terms": {name: statistics(sums) for name, sums in episodes.terms.items()},
        "metrics": {name: statistics(values) for name, values in episodes.metrics.items()},
        "num_terminated": int(episodes.terminated.sum()),
        "num_truncated": int(episodes.truncated.sum()),
        "num_cut_off": int((~ended).sum()),
        "num_diverged": int(episodes.diverged.sum()),
        "compile_s": episodes.compile_s,
        "run_s": episodes.run_s,
        "episodes": [
            {
                "return": float(episodes.returns[i]),
                "length": int(episodes.lengths[i]),
                "terminated": bool(episodes.terminated[i]),
                "truncated": bool(episodes.truncated[i]),
                "diverged": bool(episodes.diverged[i]),
                "terms": {name: float(sums[i]) for name, sums in episodes.terms.items()},
                "metrics": {name: float(values[i]) for name, values in episodes.metrics.items()},
            }
            for i in range(config.num_envs)
        ],
    }


def statistics(values: npt.NDArray[np.generic]) -> dict[str, float]:
    """Mean, standard deviation (of the population), least and greatest of `values` [N]."""
    return {name: float(getattr(values, name)()) for name in ("mean", "std", "min", "max")}


def _check_camera(camera: str | None, env: Env) -> None:
    if camera is None:
        return
    model = env.mj_model
    if model is None:
        raise ConfigError(f"camera={camera}: {env.spec.name} has no model that could be filmed")
    names = [model.camera(i).name for i in range(model.ncam)]
    if camera not in names:
        allowed = ", ".join(["null", *filter(None, names)])
        raise ConfigError(
            f"camera={camera}: unknown camera of {env.spec.name}; allowed: {allowed}"
        )


def _write_trajectory(paths: PlayPaths, env: Env, episodes: Episodes, config: PlayConfig) -> None:
    from gmijax.sim.trajectory import chosen, save_model, save_trajectory

    if env.mj_model is None:  # The controller sees that there is nothing to film.
        return
    save_model(paths.model, env.mj_model)
    num_recorded, checkpoint = episodes.qpos.shape[1], Path(str(config.checkpoint))
    env_steps = CheckpointMeta.read(checkpoint).env_steps
    trajectory = chosen(
        episodes.qpos,
        episodes.lengths[:num_recorded],
        episodes.returns[:num_recorded],
        env.spec.control_dt_s,
        count=config.num_filmed,
        title=f"{env.spec.name} after {env_steps:,} env steps",
        command=f"gmijax play run.dir={nearby(checkpoint.parents[1])} checkpoint={env_steps}",
    )
    save_trajectory(paths.trajectory, trajectory)


if __name__ == "__main__":
    sys.exit(run_gmi(_run))
