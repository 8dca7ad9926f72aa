"""An agent in this process, with trainers that take nothing."""

from __future__ import annotations

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from toy_env import point_mass
from training_jobs import wait_until

from gmijax.a3c.agent import Agent
from gmijax.a3c.board import Board, Orders, board_of, note_sizes, pack_orders, unpack_report
from gmijax.a3c.rollout import num_counts
from gmijax.cli import compose
from gmijax.collectives.board import attach_board, create_board
from gmijax.collectives.channel.interface import SenderStats
from gmijax.learner import (
    acting_weights,
    init_learner,
    make_learner,
    num_weights,
    pack_weights,
)
from gmijax.normalize import normalize
from gmijax.partition.child import ChildLink
from gmijax.policy import log_prob
from gmijax.rundir import RunPaths

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

    def send(self, experience, version, timeout_s) -> bool:
        self.was_asked.set()
        time.sleep(0.01)
        self.waited_s += 0.01
        return False

    def flush(self) -> None:
        pass

    def stats(self) -> SenderStats:
        return SenderStats(0, 0, 0, 0, self.waited_s, 0, 0.0, 0.0)

    def close(self) -> None:
        pass


@pytest.fixture
def config():
    return compose(*OVERRIDES)


def _board(config) -> Board:
    sizes = note_sizes(num_weights(ENV.spec, config.algo), num_counts(ENV), num_agents=1)
    fd = create_board()
    try:
        return board_of(attach_board(fd, sizes))
    finally:
        os.close(fd)


class _Publisher(_NoRoom):
    """Takes everything, and publishes `packed` as version 4 when it is sent the first unroll."""

    def __init__(self, board: Board, packed) -> None:
        super().__init__()
        self.taken: list = []
        self._board, self._packed = board, packed

    def send(self, experience, version, timeout_s) -> bool:
        self.taken.append(({name: x.copy() for name, x in experience.items()}, version))
        if len(self.taken) == 1:
            self._board.weights.publish(self._packed, tag=4)
        if len(self.taken) == 3:
            self._board.orders.publish(pack_orders(Orders(None, is_ending=True)))
        return True


def _agent(tmp_path, config):
    """Board with version 3 of the weights and the order to begin, link, weights, learner."""
    board, link = _board(config), ChildLink(1, RunPaths(tmp_path), None, None)
    link.paths.root.mkdir(parents=True)
    learner = make_learner(ENV.spec, config.algo)
    weights = acting_weights(learner, init_learner(learner, ENV.spec.obs_size, jax.random.key(0)))
    board.weights.publish(np.asarray(pack_weights(weights)), tag=3)
    board.orders.publish(pack_orders(Orders(None, is_ending=False)))
    return board, link, weights, learner


def test_newer_weights_are_taken_up_within_an_unroll(tmp_path, config) -> None:
    config = compose(*OVERRIDES, "algo.weights_every=2")
    board, link, weights, learner = _agent(tmp_path, config)
    bolder = weights._replace(params=weights.params._replace(log_std=weights.params.log_std + 1.0))
    sender = _Publisher(board, np.asarray(pack_weights(bolder)))
    Agent(config, ENV, 0, (0,), board, sender, link).run()
    assert [version for _, version in sender.taken] == [3, 3, 4]

    def told(experience, theirs):
        obs = normalize(theirs.moments, experience["state"])
        mean = learner.networks.action_mean(theirs.params, obs)
        return log_prob(mean, theirs.params.log_std, experience["action"])

    first, second, third = (experience for experience, _ in sender.taken)
    for experience, steps, theirs in (
        (first, slice(None), weights),
        (second, slice(0, 2), weights),
        (second, slice(2, 4), bolder),
        (third, slice(None), bolder),
    ):
        want = told(experience, theirs)[steps]
        np.testing.assert_allclose(experience["log_prob"][steps], want, rtol=1e-4, atol=1e-4)


def test_an_agent_without_room_still_adds_to_a_checkpoint(tmp_path, config) -> None:
    """At the end trainers wait for a pending checkpoint, and take nothing meanwhile."""
    board, link, _, _ = _agent(tmp_path, config)
    sender = _NoRoom()

    def added(steps: int) -> bool:
        posted = board.reports[0].read()
        return posted is not None and unpack_report(posted).checkpoint == steps

    agent = Agent(config, ENV, 0, (0,), board, sender, link)
    with ThreadPoolExecutor(1) as pool:
        outcome = pool.submit(agent.run)
        try:
            assert sender.was_asked.wait(timeout=60)
            board.orders.publish(pack_orders(Orders(5, is_ending=False)))
            wait_until(lambda: added(5), 10, "environments in the checkpoint")
        finally:
            board.orders.publish(pack_orders(Orders(9, is_ending=True)))
        told = outcome.result(timeout=20)
    assert told["unrolls"] == 0
    assert 0 < told["wait_s"] <= sender.waited_s
    assert added(9)
    saved = [path.name for path in link.run.checkpoints.glob(".*.partial/gmi_1")]
    assert len(saved) == 2
