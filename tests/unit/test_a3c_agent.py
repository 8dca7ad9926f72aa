"""An agent in this process, with trainers that take nothing."""

from __future__ import annotations

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from toy_env import point_mass
from training_jobs import wait_until

from gmijax.a3c.agent import Agent
from gmijax.a3c.job_registers import AgentCommand, AgentReport, JobRegisters, open_job_registers
from gmijax.a3c.rollout import num_counts
from gmijax.channels.registers import create_registers
from gmijax.cli.compose import compose
from gmijax.learning.learner import (
    acting_weights,
    init_learner,
    make_learner,
    num_weights,
    pack_weights,
)
from gmijax.learning.normalize import normalize
from gmijax.runs.folder import RunPaths
from gmijax.supervise.child import ChildLink

ENV = point_mass()
OVERRIDES = (
    *("env=ball_balance", "algo=a3c", "num_envs=4", "algo.unroll_length=4"),
    *("algo.policy_hidden_layer_sizes=[8]", "algo.value_hidden_layer_sizes=[8]"),
)


class _NoRoom:
    """A sender whose trainers make no room."""

    on_device = False

    def __init__(self) -> None:
        self.was_asked = threading.Event()
        self.waited_s = 0.0
        self.num_bytes = 0

    def send(self, experience, version, timeout_s) -> bool:
        self.was_asked.set()
        time.sleep(0.01)
        self.waited_s += 0.01
        return False

    def flush(self) -> None:
        pass

    def occupancy(self) -> float:
        return 0.0

    least_occupancy = occupancy


class _Publisher(_NoRoom):
    """Takes everything, and publishes `packed` as version 4 when it is sent the first unroll."""

    def __init__(self, registers: JobRegisters, packed) -> None:
        super().__init__()
        self.taken: list = []
        self._registers, self._packed = registers, packed

    def send(self, experience, version, timeout_s) -> bool:
        self.taken.append((jax.tree.map(np.copy, experience), version))
        if len(self.taken) == 1:
            self._registers.weights.publish(self._packed, tag=4)
        if len(self.taken) == 3:
            self._registers.orders.publish(AgentCommand(None, is_ending=True).pack())
        return True


def _agent(tmp_path, config):
    """Registers with version 3 of the weights and the order to begin, link, weights, learner."""
    fd, link = create_registers(), ChildLink(1, RunPaths(tmp_path), None, None)
    size = num_weights(ENV.spec, config.algo)
    registers = open_job_registers(fd, size, num_counts(ENV), num_agents=1)
    os.close(fd)
    link.paths.root.mkdir(parents=True)
    learner = make_learner(ENV.spec, config.algo)
    weights = acting_weights(learner, init_learner(learner, ENV.spec.obs_size, jax.random.key(0)))
    registers.weights.publish(np.asarray(pack_weights(weights)), tag=3)
    registers.orders.publish(AgentCommand(None, is_ending=False).pack())
    return registers, link, weights, learner


def test_newer_weights_are_taken_up_within_an_unroll(tmp_path) -> None:
    config = compose(*OVERRIDES, "algo.weights_every=2")
    registers, link, weights, learner = _agent(tmp_path, config)
    bolder = weights._replace(params=weights.params._replace(log_std=weights.params.log_std + 1.0))
    sender = _Publisher(registers, np.asarray(pack_weights(bolder)))
    Agent(config, ENV, 0, (0,), registers, sender, link).run()
    assert [version for _, version in sender.taken] == [3, 3, 4]

    @jax.jit
    def log_prob_of(experience, theirs):
        obs = normalize(theirs.moments, experience.state)
        networks, params = learner.networks, theirs.params
        output = networks.output(params, obs)
        return networks.distribution.log_prob(output, params.log_std, experience.action)

    first, second, third = (experience for experience, _ in sender.taken)
    for experience, steps, theirs in (
        (first, slice(None), weights),
        (second, slice(0, 2), weights),
        (second, slice(2, 4), bolder),
        (third, slice(None), bolder),
    ):
        want = log_prob_of(experience, theirs)[steps]
        np.testing.assert_allclose(experience.log_prob[steps], want, rtol=1e-4, atol=1e-4)


def test_an_agent_without_room_still_adds_to_a_checkpoint(tmp_path) -> None:
    """At the end trainers wait for a pending checkpoint, and take nothing meanwhile."""
    config = compose(*OVERRIDES)
    registers, link, _, _ = _agent(tmp_path, config)
    sender = _NoRoom()

    def added(steps: int) -> bool:
        snapshot = registers.reports[0].read()
        return snapshot is not None and AgentReport.unpack(snapshot.values).checkpoint == steps

    agent = Agent(config, ENV, 0, (0,), registers, sender, link)
    with ThreadPoolExecutor(1) as pool:
        outcome = pool.submit(agent.run)
        try:
            assert sender.was_asked.wait(timeout=60)
            registers.orders.publish(AgentCommand(5, is_ending=False).pack())
            wait_until(lambda: added(5), 60, "environments in the checkpoint")
        finally:
            registers.orders.publish(AgentCommand(9, is_ending=True).pack())
        summary = outcome.result(timeout=120)
    assert summary["unrolls"] == 0
    assert 0 < summary["wait_s"] <= sender.waited_s
    assert added(9)
    saved = [path.name for path in link.run.checkpoints.glob(".*.partial/gmi_1")]
    assert len(saved) == 2
