"""Lines of metrics: their numbers, what they refuse, where they go, and their thread."""

from __future__ import annotations

import json
import multiprocessing
import threading
import time
from pathlib import Path
from typing import cast

import jax.numpy as jnp
import pytest
from toy_env import metrics_from, point_mass

from gmijax.errors import NonFiniteError
from gmijax.learning.episode_window import EpisodeWindow
from gmijax.learning.evaluator import Evaluation
from gmijax.learning.member import report
from gmijax.learning.physics_health import TOLERATED_STEPS
from gmijax.learning.report_thread import ReportThread
from gmijax.learning.training_log import (
    JsonlSink,
    TensorBoardSink,
    TrainingLog,
)
from gmijax.learning.unroll import Counts, no_counts
from gmijax.ppo.loss import PpoLosses
from gmijax.sim.interface import OVERFLOWS
from gmijax.sim.wrappers import EpisodeSums

SPEC = point_mass().spec


def _counts(overflowed: dict[str, int] | None = None, **diverged: int) -> Counts:
    counts = no_counts(SPEC, tuple(overflowed or ()))
    bad = {name: jnp.asarray(float(steps)) for name, steps in diverged.items()}
    full = {name: jnp.asarray(float(steps)) for name, steps in (overflowed or {}).items()}
    return counts._replace(diverged=counts.diverged | bad, overflowed=full)


def test_few_bad_steps_are_tolerated_and_many_are_named() -> None:
    log = TrainingLog("point_mass", (), 0)
    few, many = TOLERATED_STEPS, TOLERATED_STEPS + 1
    report(log, 64, metrics_from(_counts(any=few, **{"reward/near": few})), {})
    metrics = metrics_from(_counts(any=many, **{"reward/near": many}))
    with pytest.raises(NonFiniteError, match=r"point_mass, up to env step 128: .* reward/near"):
        report(log, 128, metrics, {})


def test_a_loss_that_is_not_finite_is_named() -> None:
    metrics = metrics_from(_counts())
    spoilt = metrics._replace(
        losses=cast("PpoLosses", metrics.losses)._replace(value_loss=jnp.asarray(jnp.nan))
    )
    with pytest.raises(NonFiniteError, match="value_loss of the update is not finite"):
        report(TrainingLog("point_mass", (), 0), 64, spoilt, {})


def test_the_first_overflow_is_reported_and_all_are_logged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sink = JsonlSink(tmp_path / "metrics.jsonl")
    log = TrainingLog("point_mass", (sink,), 0)
    for iteration, count in enumerate((0, 5, 7), start=1):
        full = dict.fromkeys(OVERFLOWS, 0) | {"contact": count}
        report(log, 64 * iteration, metrics_from(_counts(full)), {})
    # Where nothing can overflow there is no line about it.
    report(TrainingLog("point_mass", (sink,), 0), 64, metrics_from(_counts()), {})
    sink.close()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line.get("physics/contact_overflow_steps") for line in lines] == [0.0, 5.0, 7.0, None]
    assert [line.get("physics/constraint_overflow_steps") for line in lines] == [0, 0, 0, None]
    assert log.overflows.steps == {"contact": 12.0, "constraint": 0.0}
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 1
    assert errors[0].startswith("point_mass: MJX-Warp's contact buffer was too small in 5 ")


def test_reports_come_in_order_from_a_thread_of_their_own_and_errors_with_the_next_call() -> None:
    written: list[int] = []

    def write(number: int) -> None:
        if number < 0:
            raise NonFiniteError("bad number")
        written.append(number)

    thread = ReportThread(write)
    for number in (1, 2, 3):
        thread.report(number)
    thread.wait()
    assert written == [1, 2, 3]
    thread.report(-1)
    with pytest.raises(NonFiniteError, match="bad number"):
        thread.report(4)
    thread.stop()
    assert written == [1, 2, 3]


def test_a_report_that_cannot_come_is_not_waited_for() -> None:
    is_there = threading.Event()
    thread = ReportThread(lambda: is_there.wait(90), last_line_s=60.0)
    thread.report()
    thread.give_up()
    started = time.monotonic()
    thread.stop()
    assert time.monotonic() - started < 30.0  # Less than for one that may come.
    is_there.set()


def test_an_evaluation_is_in_the_line_of_its_iteration_and_in_no_rate() -> None:
    written: list[dict[str, float]] = []

    class Sink:
        def write(self, line: dict[str, float]) -> None:
            written.append(line)

    log = TrainingLog("point_mass", (Sink(),), 0)
    started_s, metrics = log.last_s, metrics_from(_counts())
    evaluation = Evaluation(started_s + 2.0, 7.0, {"eval/return": 3.0, "time/eval_s": 7.0}, True)
    report(log, 100, metrics, {}, evaluation)
    report(log, 200, metrics, {}, evaluation._replace(started_s=started_s + 10.0))
    assert [line["eval/return"] for line in written] == [3.0, 3.0]
    assert [line["env_steps_per_s"] for line in written] == pytest.approx([50.0, 100.0])
    assert log.line_s == pytest.approx([2.0, 1.0])
    assert written[1]["wall_s"] == pytest.approx(10.0)


def test_terms_and_metrics_are_means_over_episodes() -> None:
    window = EpisodeWindow()
    window.add(EpisodeSums(0, 0.0, 0, {"alive": 0.0}, {"successes": 0.0}))
    names = ("return", "episode_length", "reward/alive", "metric/successes")
    assert window.means() == dict.fromkeys(names)  # From the first line on.
    assert set(window.line()) >= {f"window/{name}" for name in names}
    window.add(EpisodeSums(1, 4.0, 10, {"alive": 2.0}, {"successes": 3.0}))
    window.add(EpisodeSums(3, 8.0, 30, {"alive": 6.0}, {"successes": 5.0}))
    assert window.means() == {
        "return": 3.0,
        "episode_length": 10.0,
        "reward/alive": 2.0,
        "metric/successes": 2.0,
    }


def test_tensorboard_needs_neither_a_queue_nor_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
