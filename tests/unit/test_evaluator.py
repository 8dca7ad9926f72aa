"""Evaluations: the same whoever runs the episodes, and given up by all when a job is to end."""

from __future__ import annotations

import dataclasses
import itertools
import threading
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from toy_env import point_mass_env

from gmijax.cli.compose import compose
from gmijax.collectives.communicator import SingleRankCommunicator
from gmijax.config import TrainConfig
from gmijax.errors import ConfigError
from gmijax.learning import memory
from gmijax.learning.episodes import CHUNK_STEPS
from gmijax.learning.evaluator import Evaluation, Evaluator
from gmijax.learning.learner import init_learner, make_learner
from gmijax.runs.folder import RunPaths

EPISODES = 5
NOWHERE = RunPaths(Path("nowhere"))
"""The run folder: nothing is filmed."""
ENV = point_mass_env(episode_length=2 * CHUNK_STEPS + 10)


class Gathering:
    """`Communicator.all_gather` among threads of this process."""

    def __init__(self, world_size: int) -> None:
        self.world_size = world_size
        self.barrier = threading.Barrier(world_size, timeout=60)
        self.rows = [np.zeros(0, np.float32)] * world_size

    def of(self, rank: int) -> GatheringRank:
        return GatheringRank(self, rank)


class GatheringRank:
    def __init__(self, shared: Gathering, rank: int) -> None:
        self.shared, self.rank, self.world_size = shared, rank, shared.world_size

    def all_gather(self, values: np.ndarray) -> np.ndarray:
        assert values.dtype == np.float32
        self.shared.rows[self.rank] = values
        self.shared.barrier.wait()
        rows = np.stack(self.shared.rows)
        self.shared.barrier.wait()
        return rows


@pytest.fixture(scope="module")
def config() -> TrainConfig:
    config = compose("eval.every=100", f"eval.episodes={EPISODES}", "eval.deterministic=false")
    widths = {"policy_hidden_layer_sizes": (4,), "value_hidden_layer_sizes": (4,)}
    return dataclasses.replace(config, algo=dataclasses.replace(config.algo, **widths))


def evaluate(
    config: TrainConfig, num_gmis: int, must_stop: Callable[[int, int], bool]
) -> tuple[list[Evaluation], list[int]]:
    """Evaluations of all GMIs and their beats; `must_stop` takes a rank and its beats so far."""
    learner = make_learner(ENV.spec, config.algo)
    state = init_learner(learner, ENV.spec.obs_size, jax.random.key(1))
    gathering = Gathering(num_gmis)
    found: dict[int, Evaluation] = {}
    beats = [0] * num_gmis

    def run(rank: int) -> None:
        comm = SingleRankCommunicator() if num_gmis == 1 else gathering.of(rank)
        evaluator = Evaluator(ENV, learner, config, comm, NOWHERE)
        evaluator.trace(state)
        evaluator.compile()

        def beat() -> None:
            beats[rank] += 1

        found[rank] = evaluator.run(state, 64, beat, lambda: must_stop(rank, beats[rank]))

    threads = [threading.Thread(target=run, args=(rank,)) for rank in range(num_gmis)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [found[rank] for rank in range(num_gmis)], beats


def test_the_result_does_not_depend_on_the_number_of_gmis(config: TrainConfig) -> None:
    """Also where the episodes cannot be shared out evenly, or some GMI has none of them."""
    results = {count: evaluate(config, count, lambda *_: False) for count in (1, 4)}
    [alone], [beats] = results[1]
    assert set(alone.metrics) == {
        *("eval/return", "eval/return_std", "eval/length", "eval/distance", "time/eval_s")
    }
    assert 0 < alone.metrics["time/eval_s"] <= alone.wall_s
    assert alone.metrics["eval/return_std"] > 0
    assert beats == -(-ENV.spec.episode_length // CHUNK_STEPS)
    assert alone.is_best
    for evaluations, beats_of_all in results.values():
        assert beats_of_all == [beats] * len(evaluations)
        for found in evaluations:
            for name in alone.metrics.keys() - {"time/eval_s"}:
                assert found.metrics[name] == pytest.approx(alone.metrics[name], rel=1e-5), name


def test_all_give_up_when_one_has_been_asked_to_end_the_job(config: TrainConfig) -> None:
    evaluations, beats = evaluate(config, 2, lambda rank, beats: (rank, beats) == (1, 2))
    assert beats == [2, 2]
    for evaluation in evaluations:
        assert evaluation.metrics == {}
        assert evaluation.mean_return is None
        assert not evaluation.is_best
        assert evaluation.wall_s > 0


def test_an_evaluation_is_the_best_if_none_before_was_as_good(config: TrainConfig) -> None:
    learner = make_learner(ENV.spec, config.algo)
    evaluator = Evaluator(ENV, learner, config, SingleRankCommunicator(), NOWHERE)
    states = [init_learner(learner, ENV.spec.obs_size, jax.random.key(k)) for k in (1, 2, 3)]
    evaluator.trace(states[0])
    evaluator.compile()
    found = [evaluator.run(state, 64, lambda: None, lambda: False) for state in (*states, *states)]
    returns = [evaluation.metrics["eval/return"] for evaluation in found]
    assert returns[:3] == returns[3:]  # The same starts each time.
    records = [value for k, value in enumerate(returns) if value > max(returns[:k], default=-1e9)]
    assert [e.metrics["eval/return"] for e in found if e.is_best] == records
    assert evaluator.best == max(returns)
    assert evaluator.wall_s == pytest.approx(sum(e.wall_s for e in found))
    evaluator.best = 1e9  # Of a run that goes on.
    assert not evaluator.run(states[0], 64, lambda: None, lambda: False).is_best


def test_more_episodes_than_memory_holds_are_refused_before_they_begin(
    config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = make_learner(ENV.spec, config.algo)
    evaluator = Evaluator(ENV, learner, config, SingleRankCommunicator(), NOWHERE)
    state = init_learner(learner, ENV.spec.obs_size, jax.random.key(1))
    monkeypatch.setattr(memory, "memory_bytes", lambda: 64.0)
    with pytest.raises(ConfigError, match=r"^eval\.episodes: 5 environments in one process would"):
        evaluator.trace(state)


def test_evaluations_come_whenever_so_many_steps_are_done(config: TrainConfig) -> None:
    learner = make_learner(ENV.spec, config.algo)
    evaluator = Evaluator(ENV, learner, config, SingleRankCommunicator(), NOWHERE)
    steps = range(0, 500, 64)
    due = [end for start, end in itertools.pairwise(steps) if evaluator.is_due(end, start)]
    assert due == [128, 256, 320, 448]
