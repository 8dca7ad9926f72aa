r"""What the policies of a sweep do without noise: `python -m benchmarks.played FOLDER`.

Plays the last and the best checkpoint of every run in the same worlds, deterministically, with one
compiled program, and writes `played.json` into the folder. The best one is that of the highest
evaluation or, without evaluations, of the highest return in training. All runs must be of one
task, with networks of one shape. `benchmarks.seeds --play` calls it.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gmijax.runs.folder import read_json, write_json
from gmijax.runs.resume import CheckpointMeta, best_checkpoint, newest_checkpoint
from gmijax.runs.saved_config import trained_config

if TYPE_CHECKING:
    from gmijax.learning.episodes import EpisodeRunner, Episodes
    from gmijax.learning.learner import TrainState

FILE = "played.json"
SEED = 1_000_003
"""Far from the seeds of runs."""


class Played(NamedTuple):
    """Episodes of one checkpoint.

    Attributes:
      env_steps: how long it had been trained.
      mean_return: of its episodes.
      whole: share that ended by the time limit, and not by a failure.
      metrics: means of the task's own metrics at the ends.
    """

    env_steps: int
    mean_return: float
    whole: float
    metrics: Mapping[str, float]


def checkpoints(folder: Path) -> Iterator[tuple[str, str, Path]]:
    """Name of the run, `last` or `best`, and the checkpoint, of every run that has one."""
    for job in read_json(folder / "sweep.json")["jobs"]:
        run = folder / Path(job["run_dir"]).name
        for which, found in (
            ("last", newest_checkpoint(run).checkpoint),
            ("best", best_checkpoint(run)),
        ):
            if found is not None:
                yield run.name, which, found


def played(episodes: Episodes, env_steps: int) -> Played:
    """What is kept of episodes."""
    return Played(
        env_steps,
        float(episodes.returns.mean()),
        float(episodes.truncated.mean()),
        {name: float(values.mean()) for name, values in episodes.metrics.items()},
    )


def play_all(folder: Path, num_episodes: int) -> dict[str, dict[str, Any]]:
    """Plays all checkpoints; by name of the run and by `last` and `best`."""
    results: dict[str, dict[str, Any]] = {}
    found = list(checkpoints(folder))
    if not found:
        return results
    runner, template = _runner(found[0][2], num_episodes)
    play = functools.cache(functools.partial(_play, runner, template))
    for run, which, checkpoint in found:
        results.setdefault(run, {})[which] = play(checkpoint)._asdict()
    return results


def _runner(checkpoint: Path, num_episodes: int) -> tuple[EpisodeRunner, TrainState]:
    import jax

    from gmijax.learning.episodes import EpisodeRunner, Options
    from gmijax.learning.learner import init_learner, make_learner
    from gmijax.sim.randomize import make_worlds

    env_config, algo = trained_config(checkpoint)
    # At its full range, as `gmijax.play` does.
    env_config = dataclasses.replace(env_config, curriculum="off")
    impl = CheckpointMeta.read(checkpoint).impl
    env = make_worlds(env_config, impl, seed=SEED, first_env=0, num_envs=num_episodes)
    learner = make_learner(env.spec, algo)
    state = jax.jit(lambda key: init_learner(learner, env.spec.obs_size, key))(jax.random.key(0))
    options = Options(num_episodes, 1, SEED, deterministic=True, max_steps=None)
    runner = EpisodeRunner(env, learner, options)
    runner.trace(state)
    runner.compile()
    return runner, state


def _play(runner: EpisodeRunner, template: TrainState, checkpoint: Path) -> Played:
    from gmijax.learning.checkpoint import restore_learner

    state = restore_learner(checkpoint, template)
    episodes = runner.run(state, lambda _, running: running)
    return played(episodes, int(checkpoint.name))


def main() -> int:
    """Plays, and writes the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="of a sweep")
    parser.add_argument("--episodes", type=int, default=128, help="of every checkpoint")
    arguments = parser.parse_args()
    results = play_all(arguments.folder, arguments.episodes)
    write_json(arguments.folder / FILE, results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
