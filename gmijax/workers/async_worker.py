"""Main of a GMI in asynchronous training: `python -m gmijax.workers.async_worker`.

Started by the supervisor and by nobody else. Builds the role that the plan gives to this GMI,
agent or trainer, plugs in the registers, the channels and the reducer among the trainers, runs it,
and writes `result.json` or `error.json`.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, NamedTuple

from gmijax.config import A3cConfig, TrainConfig
from gmijax.control.decoupled import ENV_CHANNELS_FD, ENV_REGISTERS_FD, groups_of, topology_of
from gmijax.errors import ConfigError
from gmijax.partition.child import ChildLink, required_fd, run_gmi
from gmijax.partition.plan import Plan
from gmijax.rundir import read_json
from gmijax.schema import from_dict
from gmijax.workers.trainers import (
    environments_of,
    exchange_used,
    join_trainers,
    trainers_reducer,
)

if TYPE_CHECKING:
    from gmijax.a3c.board import JobRegisters
    from gmijax.collectives.ring import World
    from gmijax.sim.wrappers import BatchedEnv


class _Parts(NamedTuple):
    """What both roles are made of."""

    config: TrainConfig
    algo: A3cConfig
    plan: Plan
    env: BatchedEnv
    registers: JobRegisters
    link: ChildLink


def main() -> int:
    """Runs this process's GMI; returns the exit code."""
    return run_gmi(_run)


def _run(link: ChildLink) -> dict[str, Any]:
    config = from_dict(TrainConfig, read_json(link.run.config))
    plan = Plan.from_dict(read_json(link.run.plan))
    algo = config.algo
    if not isinstance(algo, A3cConfig):
        raise ConfigError(f"algo={algo.name}: allowed here is a3c")
    agents, trainers = groups_of(plan)
    trains = link.gmi in trainers.gmis
    # jax starts here, in the environment that the plan prepared.
    world = join_trainers(config, plan, trainers, link) if trains else None
    from gmijax.selfcheck import check_share

    check_share(plan, link.gmi)
    env = environments_of(config, _index(agents.gmis, link.gmi))
    parts = _Parts(config, algo, plan, env, _registers(algo, env, len(agents.gmis)), link)
    return _train(parts, world) if trains else _act(parts)


def _act(parts: _Parts) -> dict[str, Any]:
    from gmijax.a3c.agent import Serving, act_until_told
    from gmijax.collectives.channel.build import open_sender

    config, plan, link = parts.config, parts.plan, parts.link
    agents, trainers = groups_of(plan)
    index = _index(agents.gmis, link.gmi)
    serving = Serving(config, parts.algo, parts.env, index, trainers.gmis)
    sender = open_sender(config.channel, topology_of(plan), link.gmi, _channels_fd())
    try:
        return act_until_told(serving, parts.registers, sender, link)
    finally:
        sender.close()


def _train(parts: _Parts, world: World | None) -> dict[str, Any]:
    from gmijax.a3c.programs import exchange_size
    from gmijax.a3c.trainer import Training, learn_until_done
    from gmijax.collectives.channel.build import open_receiver

    config, plan, link = parts.config, parts.plan, parts.link
    agents, trainers = groups_of(plan)
    training = Training(config, parts.algo, parts.env, agents.gmis)
    receiver = open_receiver(config.channel, topology_of(plan), link.gmi, _channels_fd())
    num_floats = exchange_size(parts.env.spec, parts.algo)
    reducer = trainers_reducer(config, plan, trainers, link, num_floats, world)
    try:
        done = learn_until_done(training, parts.registers, receiver, reducer, link)
        return done | exchange_used(plan, reducer)
    finally:
        receiver.close()
        reducer.close()


def _registers(algo: A3cConfig, env: BatchedEnv, num_agents: int) -> JobRegisters:
    from gmijax.a3c.board import open_job_registers
    from gmijax.a3c.learner import num_weights
    from gmijax.a3c.rollout import num_stats

    fd = required_fd(ENV_REGISTERS_FD)
    return open_job_registers(fd, num_weights(env.spec, algo), num_stats(env), num_agents)


def _channels_fd() -> int:
    return required_fd(ENV_CHANNELS_FD)


def _index(gmis: tuple[int, ...], gmi: int) -> int:
    """Place of an agent among the agents; 0 for a trainer, which steps no environment."""
    return gmis.index(gmi) if gmi in gmis else 0


if __name__ == "__main__":
    sys.exit(main())
