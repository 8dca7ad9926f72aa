"""Main of a GMI in training: `python -m gmijax.workers.training_worker`.

Started by the supervisor only. Reads the run folder, does what the plan gives to
this GMI, and writes `result.json` or `error.json`.

With the template `tdg_ex` one GMI of every GPU trains and the others make its rollouts; in
asynchronous jobs agents send experience to trainers through channels. Trainers average their
gradients.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from socket import socket
from typing import TYPE_CHECKING, Any

from gmijax.collectives.nodes.rendezvous import NodeAddresses, inherited_nodes
from gmijax.config import TrainConfig
from gmijax.config.schema import from_dict
from gmijax.partition.plan import Plan
from gmijax.partition.templates import AGENT, TRAINER, Group, has_role, nodes_of
from gmijax.runs.folder import read_json
from gmijax.supervise.child import ENV_PIPES_FD, ChildLink, required_fd, run_gmi
from gmijax.supervise.job_kinds import ENV_CHANNELS_FD, ENV_REGISTERS_FD, groups_of, topology_of

if TYPE_CHECKING:
    from gmijax.baselines.tdg_ex import RemoteIteration
    from gmijax.channels.build import ChannelTopology
    from gmijax.collectives.interface import Communicator
    from gmijax.learning.learner import Learner
    from gmijax.sim.wrappers import BatchedEnv


def main() -> int:
    """Runs this process's GMI; returns the exit code."""
    return run_gmi(_run)


def _run(link: ChildLink) -> dict[str, Any] | None:
    link.keep_garbage()
    config = from_dict(TrainConfig, read_json(link.run.config))
    plan = Plan.from_dict(read_json(link.run.plan))
    # jax starts here, in the environment that the plan prepared.
    from gmijax.devices import start_device
    from gmijax.selfcheck import check_share

    start_device()
    check_share(plan, link.gmi)
    simulating, _ = groups_of(plan)
    # A trainer that steps no environment takes the sizes from those of the first GMI that does.
    rank = simulating.gmis.index(link.gmi) if link.gmi in simulating.gmis else 0
    env = environments(config, rank)
    with ExitStack() as held:
        if config.is_decoupled:
            return _run_asynchronous(config, plan, rank, env, link, held)
        return _run_synchronous(config, plan, rank, env, link, held)


def _run_synchronous(
    config: TrainConfig,
    plan: Plan,
    rank: int,
    env: BatchedEnv,
    link: ChildLink,
    held: ExitStack,
) -> dict[str, Any] | None:
    from gmijax.learning.algorithm import load_algorithm
    from gmijax.learning.loop import TrainingLoop
    from gmijax.learning.member import Member, Members

    trainers = groups_of(plan)[1]
    is_apart = plan.template == "tdg_ex"
    if is_apart and link.gmi not in trainers.gmis:
        return _serve_rollouts(config, plan, rank, env, link, held)
    algorithm = load_algorithm(config.algo)
    learner = algorithm.make_learner(env.spec, config.algo)
    num_averaged = algorithm.num_averaged(env.spec, config.algo)
    comm = _trainers_communicator(config, plan, trainers, link, num_averaged, *inherited_nodes())
    held.callback(comm.close)
    members = Members([Member(config, link.run)], link.gmi)
    loop = partial(TrainingLoop, members, algorithm, learner, env)
    exchange = exchange_used(plan, comm)
    if not is_apart:
        iteration = comm.program(partial(algorithm.iterate, env, learner))
        loop(iteration, comm, link, exchange=exchange).run()
        return None
    remote, num_workers = _remote_iteration(config, plan, env, learner, comm, link, held)
    times = remote.times
    loop(remote, comm, link, remote=num_workers, times=times, exchange=exchange).run()
    remote.close()
    return None


def _remote_iteration(
    config: TrainConfig,
    plan: Plan,
    env: BatchedEnv,
    learner: Learner,
    comm: Communicator,
    link: ChildLink,
    held: ExitStack,
) -> tuple[RemoteIteration, int]:
    """An iteration on rollouts of other GMIs, and how many these are."""
    from gmijax.baselines.tdg_ex import RemoteIteration, RolloutWorkers
    from gmijax.channels.messenger import Messenger
    from gmijax.channels.pipe_block import PipeBlock

    block = PipeBlock(required_fd(ENV_PIPES_FD), link.gmi)
    held.callback(block.close)
    mail = Messenger(block, config.reduce.timeout_s)
    here = _neighbours(plan, link.gmi, AGENT)
    workers = RolloutWorkers(mail, here, config.run.start_timeout_s)
    return RemoteIteration(env, learner, comm, workers), len(here)


def _serve_rollouts(
    config: TrainConfig,
    plan: Plan,
    rank: int,
    env: BatchedEnv,
    link: ChildLink,
    held: ExitStack,
) -> dict[str, Any]:
    """Makes rollouts for the trainer on the same GPU."""
    from gmijax.baselines.tdg_ex import serve_rollouts
    from gmijax.channels.messenger import Messenger
    from gmijax.channels.pipe_block import PipeBlock
    from gmijax.config import PpoConfig
    from gmijax.learning.learner import make_learner
    from gmijax.learning.start import first_envs

    assert isinstance(config.algo, PpoConfig)
    block = PipeBlock(required_fd(ENV_PIPES_FD), link.gmi)
    held.callback(block.close)
    [trainer] = _neighbours(plan, link.gmi, TRAINER)
    # The first weights come when the trainer is there, which may still start.
    mail = Messenger(block, max(config.reduce.timeout_s, config.run.start_timeout_s))
    learner = make_learner(env.spec, config.algo)
    state = first_envs(env, config, rank)
    rollouts = serve_rollouts(env, learner, state, mail, trainer, link.beat)
    mail.flush()
    return {"status": "completed", "rollouts": rollouts}


def _run_asynchronous(
    config: TrainConfig,
    plan: Plan,
    rank: int,
    env: BatchedEnv,
    link: ChildLink,
    held: ExitStack,
) -> dict[str, Any]:
    from gmijax.a3c.a3c import A3cLosses
    from gmijax.a3c.agent import Agent
    from gmijax.a3c.job_registers import open_job_registers
    from gmijax.a3c.rollout import num_counts
    from gmijax.a3c.trainer import Trainer
    from gmijax.channels.build import open_receiver, open_sender
    from gmijax.learning.learner import num_weights
    from gmijax.learning.updates import exchange_size
    from gmijax.workers.node_registers import over_nodes

    agents, trainers = groups_of(plan)
    sizes = num_weights(env.spec, config.algo), num_counts(env)
    registers = open_job_registers(required_fd(ENV_REGISTERS_FD), *sizes, len(agents.gmis))
    nodes, listener = inherited_nodes()
    if nodes is not None:
        at_leader = agents.gmis, trainers.gmis[0], held
        registers = over_nodes(registers, sizes, nodes, link.gmi, *at_leader)
    topology = _topology(plan, trainers, nodes)
    channels = config.channel, topology, link.gmi, required_fd(ENV_CHANNELS_FD)
    if link.gmi in agents.gmis:
        if listener is not None:
            listener.close()  # It is for trainers.
        sender = open_sender(*channels)
        held.callback(sender.close)
        return Agent(config, env, rank, trainers.gmis, registers, sender, link).run()
    receiver = open_receiver(*channels)
    held.callback(receiver.close)
    num_averaged = exchange_size(env.spec, config.algo, A3cLosses)
    comm = _trainers_communicator(config, plan, trainers, link, num_averaged, nodes, listener)
    if listener is not None:
        listener.close()  # Trainers that are all on one node connect to no others.
    held.callback(comm.close)
    trainer = Trainer(config, env, agents.gmis, registers, receiver, comm, link)
    return trainer.run() | exchange_used(plan, comm)


def _topology(plan: Plan, trainers: Group, nodes: NodeAddresses | None) -> ChannelTopology:
    """Which agent sends experience to which trainer, and to which address on another node."""
    topology = topology_of(plan)
    if nodes is None:
        return topology
    addresses = {
        (agent, trainer): at
        for (trainer, agent), at in nodes.calls.items()
        if trainer in trainers.gmis
    }
    return replace(topology, addresses=addresses, secret=nodes.token)


def environments(config: TrainConfig, rank: int) -> BatchedEnv:
    """The environments of the GMI that is number `rank` of those that simulate."""
    from gmijax.learning.start import envs_of
    from gmijax.sim.wrappers import training_env

    random_ep_len = config.algo.init_at_random_ep_len
    return training_env(envs_of(config, rank), random_ep_len=random_ep_len)


def _trainers_communicator(
    config: TrainConfig,
    plan: Plan,
    trainers: Group,
    link: ChildLink,
    num_averaged: int,
    nodes: NodeAddresses | None,
    listener: socket | None,
) -> Communicator:
    """The communicator among the trainers, whose ranks are their positions in the group.

    It averages `num_averaged` float32 in every update: a gradient and the parts of the loss.
    """
    from gmijax.collectives.communicator import CommunicatorConfig, make_communicator

    if nodes is not None:
        nodes = nodes.among(nodes_of(plan.layout, trainers.gmis))
    comm_config = CommunicatorConfig(
        layout=trainers.layout,
        rank=trainers.gmis.index(link.gmi),
        gmis=trainers.gmis,
        num_floats=num_averaged,
        exchange_fd=link.exchange_fd,
        timeout_s=config.reduce.timeout_s,
        rendezvous_timeout_s=config.run.start_timeout_s,
        intra=plan.intra,
        inter=plan.inter,
        # If it is requested by name, the error is that it does not work.
        host_if_unavailable=config.reduce.strategy != "one_shot",
        nodes=nodes,
        listener=listener,
    )
    return make_communicator(plan.strategy, comm_config)


def exchange_used(plan: Plan, comm: Communicator) -> dict[str, str]:
    """For the summary: the exchange in use, where it may differ from the plan's strategy."""
    used = {} if comm.inter is None else {"inter": comm.inter}
    if comm.strategy != plan.strategy:
        return {"strategy": comm.strategy, "intra": "host", **used}
    return {"intra": comm.intra, **used} if plan.strategy == "har" else used


def _neighbours(plan: Plan, gmi: int, role: str) -> tuple[int, ...]:
    """The GMIs on the same GPU that have a role, in order."""
    here = sorted(plan.layout.neighbours_of(gmi))
    return tuple(other for other in here if has_role(plan.roles[other], role))


if __name__ == "__main__":
    sys.exit(main())
