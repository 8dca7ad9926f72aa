"""Main of a GMI where trainers have GMIs of their own.

`python -m gmijax.workers.dedicated_worker`, started by the supervisor and by nobody else. On
every GPU one GMI trains, the others make its rollouts; the trainers of all GPUs average
their gradients.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from gmijax.config import PpoConfig, TrainConfig
from gmijax.errors import ConfigError
from gmijax.partition.child import ENV_PIPES_FD, ChildLink, required_fd, run_gmi
from gmijax.partition.plan import Plan
from gmijax.partition.templates import AGENT, TRAINER, Group, group_of, has_role
from gmijax.rundir import read_json
from gmijax.schema import from_dict
from gmijax.workers.trainers import (
    environments_of,
    exchange_used,
    join_trainers,
    trainers_reducer,
)

if TYPE_CHECKING:
    from gmijax.collectives.interface import Reducer
    from gmijax.collectives.pipe_block import PipeBlock
    from gmijax.sim.wrappers import BatchedEnv, BatchState


def main() -> int:
    """Runs this process's GMI; returns the exit code."""
    return run_gmi(_run)


def _run(link: ChildLink) -> dict[str, Any]:
    config = from_dict(TrainConfig, read_json(link.run.config))
    plan = Plan.from_dict(read_json(link.run.plan))
    trainers = group_of(plan.layout, plan.roles, TRAINER)
    servants = group_of(plan.layout, plan.roles, AGENT)
    if trainers is None or servants is None:
        raise ConfigError(f"plan: roles {list(plan.roles)} need trainers and agents")
    trains = link.gmi in trainers.gmis
    # jax starts here, in the environment that the plan prepared.
    world = join_trainers(config, plan, trainers, link) if trains else None
    from gmijax.collectives.pipe_block import PipeBlock
    from gmijax.ppo.programs import exchange_size
    from gmijax.selfcheck import check_share

    check_share(plan, link.gmi)
    place = 0 if trains else servants.gmis.index(link.gmi)
    env = environments_of(config, place)
    block = PipeBlock(required_fd(ENV_PIPES_FD), link.gmi)
    try:
        if trains:
            assert isinstance(config.algo, PpoConfig)
            num_floats = exchange_size(env.spec, config.algo)
            reducer = trainers_reducer(config, plan, trainers, link, num_floats, world)
            return _train(config, plan, reducer, env, block, link)
        return _serve(config, plan, servants, env, block, link)
    finally:
        block.close()


def _train(
    config: TrainConfig,
    plan: Plan,
    reducer: Reducer,
    env: BatchedEnv,
    block: PipeBlock,
    link: ChildLink,
) -> dict[str, Any]:
    from gmijax.collectives.messenger import Messenger
    from gmijax.ppo.remote import Servants
    from gmijax.ppo.role import train

    mail = Messenger(block, config.reduce.timeout_s)
    servants = _neighbours(plan, link.gmi, AGENT)
    try:
        remote = Servants(mail, servants, config.run.start_timeout_s)
        return train(config, env, reducer, link, remote) | exchange_used(plan, reducer)
    finally:
        reducer.close()


def _serve(
    config: TrainConfig,
    plan: Plan,
    servants: Group,
    env: BatchedEnv,
    block: PipeBlock,
    link: ChildLink,
) -> dict[str, Any]:
    from gmijax.collectives.messenger import Messenger
    from gmijax.learner import make_learner
    from gmijax.ppo.remote import serve_rollouts

    [trainer] = _neighbours(plan, link.gmi, TRAINER)
    # The first weights come when the trainer is there, which may still start.
    mail = Messenger(block, max(config.reduce.timeout_s, config.run.start_timeout_s))
    learner = make_learner(env.spec, config.algo)
    state = _first_envs(config, env, servants.gmis.index(link.gmi))
    rollouts = serve_rollouts(env, learner, state, mail, trainer, link.beat)
    mail.flush()
    return {"status": "completed", "rollouts": rollouts}


def _first_envs(config: TrainConfig, env: BatchedEnv, rank: int) -> BatchState:
    """Environments at their starts; those of a resumed run never saw the first run's."""
    from pathlib import Path

    import jax

    from gmijax.resume import CheckpointMeta
    from gmijax.sim.wrappers import env_keys

    _, key = jax.random.split(jax.random.key(config.seed))
    if config.run.resume is not None:
        steps = CheckpointMeta.read(Path(config.run.resume)).env_steps
        key = jax.random.fold_in(key, steps % 2**31)
    keys = env_keys(key, rank * config.envs_per_gmi, config.envs_per_gmi)
    return jax.jit(env.init)(env.model, keys)


def _neighbours(plan: Plan, gmi: int, role: str) -> tuple[int, ...]:
    """The GMIs on the same GPU that have a role, in order."""
    here = sorted(plan.layout.neighbours_of(gmi))
    return tuple(other for other in here if has_role(plan.roles[other], role))


if __name__ == "__main__":
    sys.exit(main())
