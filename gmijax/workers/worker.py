"""Main of one GMI: `python -m gmijax.workers.worker`.

Started by the supervisor and by nobody else. Reads the run folder, builds the role that
the plan gives to this GMI, plugs in the concrete reducer, runs it, and writes
`result.json` or `error.json`.
"""

from __future__ import annotations

import sys
from typing import Any

from gmijax.config import PpoConfig, TrainConfig
from gmijax.partition.child import ChildLink, run_gmi
from gmijax.partition.plan import Plan
from gmijax.partition.templates import Group
from gmijax.rundir import read_json
from gmijax.schema import from_dict
from gmijax.workers.trainers import (
    environments_of,
    exchange_used,
    join_trainers,
    trainers_reducer,
)


def main() -> int:
    """Runs this process's GMI; returns the exit code."""
    return run_gmi(_run)


def _run(link: ChildLink) -> dict[str, Any]:
    config = from_dict(TrainConfig, read_json(link.run.config))
    plan = Plan.from_dict(read_json(link.run.plan))
    everyone = Group(tuple(plan.layout.gmis), plan.layout)
    # jax starts here, in the environment that the plan prepared.
    world = join_trainers(config, plan, everyone, link)
    from gmijax.selfcheck import check_share

    check_share(plan, link.gmi)
    from gmijax.ppo.programs import exchange_size
    from gmijax.ppo.role import train

    assert isinstance(config.algo, PpoConfig)  # Others have a main of their own.
    env = environments_of(config, link.gmi)
    num_floats = exchange_size(env.spec, config.algo)
    reducer = trainers_reducer(config, plan, everyone, link, num_floats, world)
    try:
        return train(config, env, reducer, link) | exchange_used(plan, reducer)
    finally:
        reducer.close()


if __name__ == "__main__":
    sys.exit(main())
