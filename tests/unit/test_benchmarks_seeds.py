"""How the benchmark of seeds reads its rows, and what it keeps."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from benchmarks import seeds
from benchmarks.records import read_calls
from benchmarks.seeds import Benchmark, Row, checked, row_of
from gmijax.errors import ConfigError
from gmijax.runs.folder import write_json


def arguments(folder: Path, **changes: Any) -> argparse.Namespace:
    own: dict[str, Any] = {
        **{"overrides": ["env=ball_balance"], "row": [], "seeds": 4, "at_once": "2"},
        **{"pack": "gmi", "play": 0},
        **{"deadline_s": None, "runs": folder / "runs", "analyse": [], "out": folder / "results"},
    }
    return argparse.Namespace(**{**own, **changes})


def write_sweep(folder: Path, finals: Mapping[str, float], status: str = "completed") -> None:
    """A sweep whose jobs rise to 1 and end at `finals`; seed -> reward."""
    jobs = []
    for number, (seed, final) in enumerate(finals.items()):
        run = folder / f"{number:03d}"
        run.mkdir(parents=True)
        rewards = [1.0] * 20 + [final] * 20
        lines = [{"env_steps": k, "reward_per_step": reward} for k, reward in enumerate(rewards)]
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (run / "metrics.jsonl").write_text(text)
        job = {"overrides": {"seed": seed}, "wall_s": 5.0, "state": "completed"}
        jobs.append({**job, "run_dir": f"/elsewhere/{run.name}"})
    jobs.append({**jobs[0], "state": "interrupted"})
    report = {"status": status, "trainings_per_hour": 100.0, "jobs": jobs}
    (folder / "sweep.json").write_text(json.dumps(report))


def test_a_row_has_a_name_and_overrides() -> None:
    assert row_of("baseline") == Row("baseline", ())
    told = "no clip: algo.clip_value_loss=false 'algo.policy_hidden_layer_sizes=[64, 32]'"
    expected = ("algo.clip_value_loss=false", "algo.policy_hidden_layer_sizes=[64, 32]")
    assert row_of(told) == Row("no clip", expected)
    assert Row("apart, no clip", ()).folder == "apart-no-clip"


def test_bad_input_is_told_before_anything_is_trained(tmp_path: Path) -> None:
    for changes, message in (
        ({"analyse": [tmp_path]}, "has no sweep.json"),
        ({}, "nothing to do"),
    ):
        with pytest.raises(ConfigError, match=message):
            checked(arguments(tmp_path, **changes), [])
    for rows, message in (
        ([Row("a", ()), Row("a", ())], "--row a: two rows have this name"),
        ([Row("a", ("algo.clip_valu_loss=false",))], "clip_valu_loss"),
    ):
        with pytest.raises(ConfigError, match=message):
            checked(arguments(tmp_path), rows)
    assert checked(arguments(tmp_path), [Row("a", ("seed=1",))]) == "ball_balance"


def test_rows_are_kept_one_by_one_and_compared_with_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    commands: list[Sequence[str]] = []

    def run(command: Sequence[str], _: float) -> int:
        commands.append(command)
        if len(commands) == 3:
            raise KeyboardInterrupt
        folder = Path(command[-1].partition("=")[2])
        write_sweep(folder, {"0": 0.95, "1": 0.9 if "seed=range(4)" in command else 0.1})
        return 0

    monkeypatch.setattr(seeds, "run_command", run)
    write_sweep(tmp_path / "before", {"0": 0.95, "1": 0.5})
    found = Benchmark(arguments(tmp_path), "ball_balance")
    found.analyse(tmp_path / "before")
    with pytest.raises(KeyboardInterrupt):
        found.run([Row("no clip", ("algo.clip_value_loss=false",)), Row("b", ()), Row("c", ())])
    (call,) = read_calls(found.file.path)
    assert found.file.path.name == "seeds-ball_balance-cpu.json"
    before, row, _ = call.results["rows"]
    assert (before["row"], before["seeds"], before["successes"], before["unfinished"]) == (
        *("before", 2, 1),
        1,
    )
    assert "p_final" not in before
    assert (row["overrides"], row["successes"]) == (["algo.clip_value_loss=false"], 2)
    assert row["p_successes"] == 1.0
    assert [one["seed"] for one in row["each"]] == ["0", "1"]
    assert "algo.clip_value_loss=false" in commands[0]
    assert f"run.dir={tmp_path}/runs/no-clip" in commands[0]
    assert "no clip: 2 of 2" in capsys.readouterr().out


def test_no_row_is_begun_that_would_not_end_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 0.0

    def run(command: Sequence[str], _: float) -> int:
        nonlocal now_s
        now_s += 60.0
        write_sweep(Path(command[-1].partition("=")[2]), {"0": 1.0})
        return 0

    monkeypatch.setattr(seeds.time, "monotonic", lambda: now_s)
    monkeypatch.setattr(seeds, "run_command", run)
    found = Benchmark(arguments(tmp_path, deadline_s=150.0), "ball_balance")
    found.run([Row(name, ()) for name in "abc"])
    assert [row["row"] for row in found.rows] == ["a", "b"]


def test_checkpoints_are_played_after_their_row_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(command: Sequence[str], _: float) -> int:
        if "benchmarks.played" not in command:
            write_sweep(Path(command[-1].partition("=")[2]), {"0": 1.0, "1": 1.0})
            return 0
        assert command[-2:] == ["--episodes", "64"]
        one = {"env_steps": 10, "mean_return": 5.0, "whole": 0.5, "metrics": {}}
        write_json(Path(command[3]) / "played.json", {"000": {"last": one}})
        return 0

    monkeypatch.setattr(seeds, "run_command", run)
    found = Benchmark(arguments(tmp_path, play=64), "ball_balance")
    found.run([Row("a", ())])
    first, second = (one["at_end"] for one in found.rows[0]["each"])
    assert first == {"played/last/mean_return": 5.0, "played/last/whole": 0.5}
    assert not second
    assert "played/last/whole 0.5 (0.5 to 0.5)" in capsys.readouterr().out


@pytest.mark.parametrize(("code", "played"), [(0, True), (1, True), (130, False)])
def test_only_checkpoints_of_a_sweep_that_came_to_its_end_are_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, played: bool
) -> None:
    folder = tmp_path / "a"
    stale = folder / "played.json"

    def run(command: Sequence[str], _: float) -> int:
        if "benchmarks.played" in command:
            assert not stale.exists()
            return 3
        write_sweep(folder, {"0": 1.0})
        return code

    monkeypatch.setattr(seeds, "run_command", run)
    found = Benchmark(arguments(tmp_path, play=64, runs=tmp_path), "ball_balance")
    folder.mkdir()
    one = {"env_steps": 10, "mean_return": 5.0, "whole": 0.5, "metrics": {}}
    write_json(stale, {"000": {"last": one}})
    found.run([Row("a", ())])
    assert not found.rows[0]["each"][0]["at_end"]
    assert found.rows[0].get("play_code") == (3 if played else None)
