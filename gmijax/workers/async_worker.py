"""Main of a GMI in asynchronous training: `python -m gmijax.workers.async_worker`.

Started by the supervisor and by nobody else. Builds the role that the plan gives to this GMI,
agent or trainer, plugs in the registers, the channels and the reducer among the trainers, runs it,
and writes `result.json` or `error.json`.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from gmijax.config import A3cConfig, TrainConfig
from gmijax.errors import ConfigError
from gmijax.supervise.child import ChildLink, required_fd, run_gmi
from gmijax.supervise.kinds import ENV_CHANNELS_FD, ENV_REGISTERS_FD, groups_of, topology_of
from gmijax.workers.trainers import (
    environments_of,
    exchange_used,
    read_job,
    trainers_reducer,
)

if TYPE_CHECKING:
    from gmijax.a3c.job_registers import JobRegisters
    from gmijax.sim.wrappers import BatchedEnv


def main() -> int:
    """Runs this process's GMI; returns the exit code."""
    return run_gmi(_run)


def _run(link: ChildLink) -> dict[str, Any]:
    config, plan = read_job(link)
    if not isinstance(config.algo, A3cConfig):
        raise ConfigError(f"algo={config.algo.name}: allowed here is a3c")
    agents, trainers = groups_of(plan)
    trains = link.gmi in trainers.gmis
    # jax starts here, in the environment that the plan prepared.
    from gmijax.a3c.a3c import A3cLosses
    from gmijax.a3c.agent import Agent
    from gmijax.a3c.trainer import Trainer
    from gmijax.collectives.channel.build import open_receiver, open_sender
    from gmijax.learning.updates import exchange_size
    from gmijax.selfcheck import check_share

    check_share(plan, link.gmi)
    place = 0 if trains else agents.gmis.index(link.gmi)  # A trainer steps no environment.
    env = environments_of(config, place)
    registers = _registers(config, env, len(agents.gmis))
    channels = config.channel, topology_of(plan), link.gmi, required_fd(ENV_CHANNELS_FD)
    with ExitStack() as held:
        if not trains:
            sender = open_sender(*channels)
            held.callback(sender.close)
            return Agent(config, env, place, trainers.gmis, registers, sender, link).run()
        receiver = open_receiver(*channels)
        held.callback(receiver.close)
        num_floats = exchange_size(env.spec, config.algo, A3cLosses)
        reducer = trainers_reducer(config, plan, trainers, link, num_floats)
        held.callback(reducer.close)
        trainer = Trainer(config, env, agents.gmis, registers, receiver, reducer, link)
        return trainer.run() | exchange_used(plan, reducer)


def _registers(config: TrainConfig, env: BatchedEnv, num_agents: int) -> JobRegisters:
    from gmijax.a3c.job_registers import open_job_registers
    from gmijax.a3c.rollout import num_counts
    from gmijax.learning.learner import num_weights

    fd = required_fd(ENV_REGISTERS_FD)
    return open_job_registers(fd, num_weights(env.spec, config.algo), num_counts(env), num_agents)


if __name__ == "__main__":
    sys.exit(main())
