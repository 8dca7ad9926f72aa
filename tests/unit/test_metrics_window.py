"""Means over the latest episodes, and where lines go."""

import multiprocessing
import threading
from pathlib import Path

import pytest

from gmijax.metrics import EpisodeWindow, TensorBoardSink
from gmijax.sim.wrappers import EpisodeSums


def test_terms_and_metrics_are_means_over_episodes():
    window = EpisodeWindow()
    window.add(EpisodeSums(1, 4.0, 10, {"alive": 2.0}, {"successes": 3.0}))
    window.add(EpisodeSums(3, 8.0, 30, {"alive": 6.0}, {"successes": 5.0}))
    assert window.means() == {
        "return": 3.0,
        "episode_length": 10.0,
        "reward/alive": 2.0,
        "metric/successes": 2.0,
    }


def test_there_are_no_means_before_an_episode_has_ended():
    window = EpisodeWindow()
    window.add(EpisodeSums(0, 0.0, 0, {"alive": 0.0}, {}))
    assert window.means() == {"return": None, "episode_length": None}


def test_tensorboard_needs_neither_a_queue_nor_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError("/dev/shm cannot be written")

    monkeypatch.setattr(multiprocessing, "Queue", refuse)
    monkeypatch.setattr(threading.Thread, "start", refuse)
    sink = TensorBoardSink(tmp_path)
    sink.write({"env_steps": 640, "return": 1.5, "loss/policy": 2, "episode_length": None})
    # Before it is closed: a process that is killed must have left its lines.
    [events] = tmp_path.iterdir()
    written = events.read_bytes()
    assert b"train/return" in written
    assert b"loss/policy" in written
    assert b"episode_length" not in written
    sink.close()
