"""Over which episodes a job takes its means: at the start, in step, after a resume."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gmijax.cli.compose import compose
from gmijax.config.schema import to_dict
from gmijax.learning.checkpoint import checkpoint_meta, finish_checkpoint, save_episodes
from gmijax.learning.episode_window import WINDOW_EPISODES, EpisodeWindow, Standing
from gmijax.learning.kept_checkpoints import remove
from gmijax.learning.start import first_window
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import RunPaths, write_json
from gmijax.runs.ranking import best_checkpoint
from gmijax.sim.wrappers import EpisodeSums

LIMIT, UNROLL = 200, 8
SHORT = (3, 30)


def sums(lengths: np.ndarray) -> EpisodeSums:
    """Episodes in which every step costs 1."""
    total = float(lengths.sum())
    return EpisodeSums(float(len(lengths)), -total, total, {"time": -total}, {"ends": total})


class Envs:
    """Environments whose steps cost 1; a third of all episodes ends early, the others at LIMIT."""

    def __init__(self, count: int, *, head_starts: bool = False) -> None:
        self.count, self.random = count, np.random.default_rng(0)
        self.ends, self.lengths = self._draw(count), np.zeros(count)
        # `algo.init_at_random_ep_len`: the first episode is cut, and does not count.
        self.is_cut = np.full(count, head_starts)
        if head_starts:
            self.ends = np.minimum(self.ends, self.random.integers(1, LIMIT, count))

    def iterate(self) -> EpisodeSums:
        found = []
        for _ in range(UNROLL):
            self.lengths += 1
            over = self.lengths >= self.ends
            found.append(self.lengths[over & ~self.is_cut])
            self.is_cut[over] = False
            self.ends[over], self.lengths[over] = self._draw(int(over.sum())), 0
        return sums(np.concatenate(found))

    def _draw(self, count: int) -> np.ndarray:
        is_short = self.random.random(count) < 1 / 3
        return np.where(is_short, self.random.integers(*SHORT, count), LIMIT)


MEAN = -(np.mean(range(*SHORT)) + 2 * LIMIT) / 3


@pytest.mark.parametrize("head_starts", [False, True])
@pytest.mark.parametrize("count", [16, 64, 4096])
def test_a_full_window_has_episodes_of_every_length_as_often_as_they_occur(
    count: int, head_starts: bool
) -> None:
    envs, window = Envs(count, head_starts=head_starts), EpisodeWindow(LIMIT * count)
    full, first, early = [], None, None
    for iteration in range(1, 6 * LIMIT // UNROLL * max(1, 64 // count)):
        window.add(envs.iterate(), UNROLL * count)
        standing = window.standing()
        early = early or standing.mean_return
        if standing.is_full:
            first = first or iteration * UNROLL
            full.append(standing.mean_return)
            assert (window.line()["window/episodes"] or 0) >= WINDOW_EPISODES
    assert early is not None
    assert first is not None
    assert first >= 2 * LIMIT  # The first one is left out.
    if not head_starts:
        assert early > 0.3 * MEAN  # What a sweep ranked by.
    np.testing.assert_allclose(full, MEAN, rtol=0.25 if count < 4096 else 0.08)


def test_episodes_that_run_out_of_time_alone_are_a_full_window_when_there_are_enough() -> None:
    window, fullness = EpisodeWindow(10 * LIMIT), []
    for _ in range(15):
        window.add(sums(np.full(10, LIMIT)), 10 * LIMIT)
        fullness.append(window.standing().is_full)
    # The first ten end with the first time limit; a hundred others come after it.
    assert fullness == [False] * 10 + [True] * 5
    silent = EpisodeWindow(10 * LIMIT)
    silent.add(sums(np.zeros(0)), 1e6)  # No episode has ended.
    assert silent.standing() == Standing(None, False, 10 * LIMIT)
    assert silent.line()["window/episodes"] == 0


def test_the_short_window_is_the_fewest_iterations_with_a_hundred_episodes() -> None:
    window = EpisodeWindow(1e9)
    for length in (5, 7, 9):
        window.add(sums(np.full(60, length)), 60)
    assert window.means()["return"] == -8.0
    assert window.line()["window/return"] == -7.0
    assert window.line()["window/metric/ends"] == 7.0


def test_a_window_goes_on_after_a_resume_as_if_nothing_had_been(tmp_path: Path) -> None:
    config, count = compose("env=ant"), 64
    envs, whole = Envs(count), EpisodeWindow(LIMIT * count)
    run, lines = RunPaths(tmp_path), []
    write_json(run.config, to_dict(config))
    for iteration in range(3 * LIMIT // UNROLL):
        if iteration == 60:
            save_episodes(run, 60, config, whole.state())
            standing = whole.standing()
        whole.add(envs.iterate(), UNROLL * count)
        lines.append(whole.line())
    checkpoint = finish_checkpoint(run, checkpoint_meta(config, 60, 1, standing))
    assert CheckpointMeta.read(checkpoint).window_full
    assert CheckpointMeta.read(checkpoint).mean_return == standing.mean_return

    resume = f"run.resume={checkpoint}"
    again = Envs(count)
    # Environments that begin anew: what was measured counts, a new first time limit does not.
    resumed = first_window(compose("env=ant", resume), LIMIT * count, 0, None)
    assert resumed.standing() == standing._replace(is_full=False)
    resumed.restore(
        whole.state() | json.loads((checkpoint / "episodes.json").read_text()), envs_go_on=True
    )
    for iteration in range(3 * LIMIT // UNROLL):
        episodes = again.iterate()
        if iteration >= 60:
            resumed.add(episodes, UNROLL * count)
            assert resumed.line() == lines[iteration]
    # Returns with other weights are others.
    other = first_window(compose("env=ant", "env.rewards.energy=-1", resume), 1.0, 0, None)
    assert other.standing() == Standing(None, False, 1.0)


def test_a_checkpoint_whose_window_is_not_full_is_best_only_among_its_like(tmp_path: Path) -> None:
    run, config = RunPaths(tmp_path), compose("env=ant")

    def save(env_steps: int, mean: float | None, is_full: bool) -> None:
        save_episodes(run, env_steps, config, EpisodeWindow().state())
        meta = checkpoint_meta(config, env_steps, 1, Standing(mean, is_full))
        finish_checkpoint(run, meta, keep=2)

    save(1, -6.3, False)
    save(2, -9.0, False)
    assert best_checkpoint(run.root) == run.checkpoint(1)
    for env_steps, mean in ((3, -138.0), (4, -120.0), (5, -130.0)):
        save(env_steps, mean, True)
    save(6, -6.0, False)  # Environments that began anew.
    assert best_checkpoint(run.root) == run.checkpoint(4)
    assert sorted(int(path.name) for path in run.checkpoints.iterdir()) == [4, 6]


def test_checkpoints_are_compared_by_episodes_of_their_own_policies(tmp_path: Path) -> None:
    """The window of a checkpoint is of episodes that began up to two time limits before it."""
    run, config = RunPaths(tmp_path), compose("env=ant")
    window, count = EpisodeWindow(LIMIT * 128), 128
    # What a step earns by the policy of each time limit; the fifth is the best.
    pays = (1.0, 2.0, 3.0, 4.0, 9.0, 1.0, 0.5)
    lines, earned = [], np.zeros(count)
    ages = np.arange(count) % LIMIT  # Episodes do not end in step.
    for step in range(len(pays) * LIMIT):
        earned, ages = earned + pays[step // LIMIT], ages + 1
        over = ages == LIMIT
        ended, total = int(over.sum()), float(earned[over].sum())
        sums = EpisodeSums(float(ended), total, float(ended * LIMIT), {"time": total}, {})
        window.add(sums, count)
        earned[over], ages[over] = 0.0, 0
        env_steps = (step + 1) * count
        lines.append({"env_steps": env_steps, **window.line()})
        if (step + 1) % LIMIT == LIMIT // 2:  # Within the time of one policy.
            save_episodes(run, env_steps, config, window.state())
            finish_checkpoint(run, checkpoint_meta(config, env_steps, 1, window.standing()))
    at = {number: (number * LIMIT + LIMIT // 2) * count for number in range(len(pays))}
    by_window = max(
        at, key=lambda number: CheckpointMeta.read(run.checkpoint(at[number])).mean_return or 0
    )
    assert by_window == 5  # Its own policy is one of the worst.
    write_lines(run, lines)
    assert best_checkpoint(run.root) == run.checkpoint(at[4])
    # The last has no later episodes: it is judged by what there is, and is best among equals.
    write_lines(run, lines[: at[4] // count])
    for number in (5, 6):
        remove(run, run.checkpoint(at[number]))
    assert best_checkpoint(run.root) == run.checkpoint(at[4])


def write_lines(run: RunPaths, lines: list[dict[str, float | None]]) -> None:
    run.metrics.write_text("".join(json.dumps(line) + "\n" for line in lines))
