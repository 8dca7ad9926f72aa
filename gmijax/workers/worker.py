"""Main of a GMI in synchronous training: `python -m gmijax.workers.worker`.

Started by the supervisor and by nobody else. Reads the run folder, plugs in the concrete reducer,
trains, and writes `result.json` or `error.json`. With the template `tdg_ex` one GMI of every GPU
trains and the others make its rollouts; the trainers of all GPUs average their gradients.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from gmijax.config import PpoConfig, TrainConfig
from gmijax.partition.plan import Plan
from gmijax.partition.templates import AGENT, TRAINER, has_role
from gmijax.supervise.child import ENV_PIPES_FD, ChildLink, required_fd, run_gmi
from gmijax.supervise.kinds import groups_of
from gmijax.workers.trainers import (
    environments_of,
    exchange_used,
    read_job,
    trainers_reducer,
)

if TYPE_CHECKING:
    from gmijax.collectives.messages.pipe_block import PipeBlock
    from gmijax.sim.wrappers import BatchedEnv


def main() -> int:
    """Runs this process's GMI; returns the exit code."""
    return run_gmi(_run)


def _run(link: ChildLink) -> dict[str, Any]:
    config, plan = read_job(link)
    assert isinstance(config.algo, PpoConfig)  # Others have a main of their own.
    simulating, trainers = groups_of(plan)
    trains = link.gmi in trainers.gmis
    # jax starts here, in the environment that the plan prepared.
    from gmijax.collectives.messages.messenger import Messenger
    from gmijax.collectives.messages.pipe_block import PipeBlock
    from gmijax.learning.updates import exchange_size
    from gmijax.ppo.loop import TrainingLoop
    from gmijax.ppo.ppo import PpoLosses
    from gmijax.ppo.tdg_ex import RolloutWorkers
    from gmijax.selfcheck import check_share

    check_share(plan, link.gmi)
    place = simulating.gmis.index(link.gmi) if link.gmi in simulating.gmis else 0
    env = environments_of(config, place)
    workers = None
    with ExitStack() as held:
        if plan.template == "tdg_ex":
            block = PipeBlock(required_fd(ENV_PIPES_FD), link.gmi)
            held.callback(block.close)
            if not trains:
                return _serve(config, plan, place, env, block, link)
            mail = Messenger(block, config.reduce.timeout_s)
            here = _neighbours(plan, link.gmi, AGENT)
            workers = RolloutWorkers(mail, here, config.run.start_timeout_s)
        num_floats = exchange_size(env.spec, config.algo, PpoLosses)
        reducer = trainers_reducer(config, plan, trainers, link, num_floats)
        held.callback(reducer.close)
        loop = TrainingLoop(config, env, reducer, link, workers)
        return loop.run() | exchange_used(plan, reducer)


def _serve(
    config: TrainConfig,
    plan: Plan,
    place: int,
    env: BatchedEnv,
    block: PipeBlock,
    link: ChildLink,
) -> dict[str, Any]:
    """Makes rollouts for the trainer on the same GPU."""
    from gmijax.collectives.messages.messenger import Messenger
    from gmijax.learning.learner import make_learner
    from gmijax.learning.start import first_envs
    from gmijax.ppo.tdg_ex import serve_rollouts

    assert isinstance(config.algo, PpoConfig)
    [trainer] = _neighbours(plan, link.gmi, TRAINER)
    # The first weights come when the trainer is there, which may still start.
    mail = Messenger(block, max(config.reduce.timeout_s, config.run.start_timeout_s))
    learner = make_learner(env.spec, config.algo)
    state = first_envs(env, config, place)
    rollouts = serve_rollouts(env, learner, state, mail, trainer, link.beat)
    mail.flush()
    return {"status": "completed", "rollouts": rollouts}


def _neighbours(plan: Plan, gmi: int, role: str) -> tuple[int, ...]:
    """The GMIs on the same GPU that have a role, in order."""
    here = sorted(plan.layout.neighbours_of(gmi))
    return tuple(other for other in here if has_role(plan.roles[other], role))


if __name__ == "__main__":
    sys.exit(main())
