"""Main of the child that plays a shipped policy in plain MuJoCo: `plain_playback.py FOLDER [S]`.

Started by `gmijax.deploy.shipped` only. Writes what `gmijax.workers.playback` does, without jax.
After S seconds it plays no more episodes than a film shows.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from gmijax.config import PlayConfig
from gmijax.config.schema import from_dict
from gmijax.errors import ConfigError
from gmijax.player.outcome import summarise
from gmijax.player.plain_env import PlainEnv, task_of
from gmijax.player.policy import PlainPolicy
from gmijax.player.returns import Played, play, together
from gmijax.player.shipped import shipped_policy
from gmijax.runs.folder import PlayPaths, RunPaths, read_json, write_json
from gmijax.sim.camera import check_camera, choose_camera
from gmijax.sim.trajectory import save_model, save_trajectory


def main(arguments: Sequence[str]) -> int:
    """Returns the exit code: 0, or 2 with one line on standard error."""
    folder, *limit = arguments
    try:
        _run(Path(folder), float(limit[0]) if limit else math.inf)
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


def _run(folder: Path, seconds: float) -> None:
    config = from_dict(PlayConfig, read_json(RunPaths(folder).config))
    task, paths = str(config.run.env), PlayPaths(folder)
    policy = shipped_policy(task)
    env = PlainEnv(task_of(policy))
    check_camera(env.model, config.camera, task)
    started_s = time.monotonic()
    episodes = together(list(_in_time(policy, config, seconds)), time.monotonic() - started_s)
    env_steps = policy.about.get("env_steps")
    # What is played for so long only is the demo's film.
    command = f"gmijax demo env={task}"
    if math.isinf(seconds):
        command = f"gmijax play env={task} checkpoint=shipped{config.film_overrides()}"
    trajectory = episodes.filmed(
        env.spec.control_dt_s,
        count=config.num_filmed,
        title=f"{task}, trained for {env_steps:,} env steps",
        command=command,
    )
    save_model(paths.model, env.model)
    save_trajectory(paths.trajectory, trajectory)
    about = {
        "impl": "c",
        "device": "cpu: MuJoCo in C",
        "camera": choose_camera(env.model, config.camera).name,
        "policy": dict(policy.about),
    }
    # Written last: a reader that sees it finds the trajectory complete.
    write_json(paths.returns, {**summarise(config, task, env_steps, episodes), **about})


def _in_time(policy: PlainPolicy, config: PlayConfig, seconds: float) -> Iterator[Played]:
    started_s = time.monotonic()
    episodes = play(policy, config.num_envs, config.seed, config.max_steps)
    for number, episode in enumerate(episodes, 1):
        yield episode
        played_s = time.monotonic() - started_s
        if number >= config.num_filmed and played_s > seconds:
            return


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
