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

from gmijax.a3c.agent import Serving, act_until_told
from gmijax.a3c.board import Board, Orders, board_of, note_sizes, pack_orders, unpack_report
from gmijax.a3c.learner import acting_weights, num_weights, pack_weights
from gmijax.a3c.rollout import num_stats
from gmijax.cli import compose
from gmijax.collectives.board import attach_board, create_board
from gmijax.collectives.channel.interface import SenderStats
from gmijax.learner import init_learner, make_learner
from gmijax.partition.child import ChildLink
from gmijax.rundir import RunPaths

ENV = point_mass()


class _NoRoom:
    """A sender whose trainers make no room."""

    def __init__(self) -> None:
        self.was_asked = threading.Event()

    def send(self, experience, version, timeout_s) -> bool:
        self.was_asked.set()
        time.sleep(0.01)
        return False

    def flush(self) -> None:
        pass

    def stats(self) -> SenderStats:
        return SenderStats(0, 0, 0, 0, 0.0, 0, 0.0, 0.0)

    def close(self) -> None:
        pass


@pytest.fixture
def config():
    return compose(
        "env=ball_balance", "algo=a3c", "num_envs=4", "algo.unroll_length=4",
        "algo.policy_hidden_layer_sizes=[8]", "algo.value_hidden_layer_sizes=[8]",
    )  # fmt: skip


def _board(config) -> Board:
    sizes = note_sizes(num_weights(ENV.spec, config.algo), num_stats(ENV), num_agents=1)
    fd = create_board()
    try:
        return board_of(attach_board(fd, sizes))
    finally:
        os.close(fd)


def test_an_agent_without_room_still_adds_to_a_checkpoint(tmp_path, config) -> None:
    """At the end trainers wait for a pending checkpoint, and take nothing meanwhile."""
    board, sender, link = _board(config), _NoRoom(), ChildLink(1, RunPaths(tmp_path), None, None)
    link.paths.root.mkdir(parents=True)
    learner = make_learner(ENV.spec, config.algo)
    state = init_learner(learner, ENV.spec.obs_size, jax.random.key(0))
    board.weights.publish(np.asarray(pack_weights(acting_weights(learner, state))), tag=3)
    board.orders.publish(pack_orders(Orders(None, is_ending=False)))

    def added(steps: int) -> bool:
        posted = board.reports[0].read()
        return posted is not None and unpack_report(posted).checkpoint == steps

    serving = Serving(config, config.algo, ENV, index=0, trainers=(0,))
    with ThreadPoolExecutor(1) as pool:
        outcome = pool.submit(act_until_told, serving, board, sender, link)
        try:
            assert sender.was_asked.wait(timeout=60)
            board.orders.publish(pack_orders(Orders(5, is_ending=False)))
            wait_until(lambda: added(5), 10, "environments in the checkpoint")
        finally:
            board.orders.publish(pack_orders(Orders(9, is_ending=True)))
        assert outcome.result(timeout=20)["unrolls"] == 0
    assert added(9)
    saved = [path.name for path in link.run.checkpoints.glob(".*.partial/gmi_1")]
    assert len(saved) == 2
