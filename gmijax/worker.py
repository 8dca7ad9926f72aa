"""Main of one GMI: `python -m gmijax.worker`, started by the supervisor and by nobody else.

Reads the run folder, builds the role that the plan gives to this GMI, plugs in the concrete
reducer, runs it, and writes `result.json` or `error.json`.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from gmijax.config import TrainConfig
from gmijax.partition.child import ChildLink, run_gmi
from gmijax.partition.plan import Plan
from gmijax.rundir import read_json
from gmijax.schema import from_dict

if TYPE_CHECKING:
    pass


def main() -> int:
    """Runs this process's GMI; returns the exit code."""
    return run_gmi(_run)


def _run(link: ChildLink) -> dict[str, Any]:
    config = from_dict(TrainConfig, read_json(link.run.config))
    plan = Plan.from_dict(read_json(link.run.plan))
    # jax starts here, in the environment that the plan prepared.
    from gmijax.collectives.build import Membership, build_reducer, join_world

    start_timeout_s = config.run.start_timeout_s
    world = join_world(plan.strategy, plan.layout, link.gmi, link.rendezvous, start_timeout_s)
    from gmijax.ppo.programs import exchange_size
    from gmijax.ppo.role import train
    from gmijax.sim.randomize import randomized
    from gmijax.sim.registry import make_env
    from gmijax.sim.wrappers import training_env

    env = make_env(
        str(config.env.name),
        suite=config.env.suite,
        impl=config.physics.impl,
        episode_length=config.env.episode_length,
        max_envs=config.num_envs,
    )
    if config.env.randomize == "on":
        env = randomized(
            env,
            config.env.randomization,
            seed=config.seed,
            first_env=link.gmi * config.num_envs,
            num_envs=config.num_envs,
        )
    reducer = build_reducer(
        plan.strategy,
        Membership(
            layout=plan.layout,
            rank=link.gmi,
            num_floats=exchange_size(env.spec, config.algo),
            exchange_fd=link.exchange_fd,
            timeout_s=config.reduce.timeout_s,
            rendezvous_timeout_s=start_timeout_s,
            world=world,
            intra=plan.intra,
        ),
    )
    try:
        return train(config, training_env(env), reducer, link)
    finally:
        reducer.close()


if __name__ == "__main__":
    sys.exit(main())
