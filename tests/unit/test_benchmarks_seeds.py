"""How the benchmark of seeds reads its rows, and what it keeps of a sweep."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.seeds import Row, checked, line, outcomes_of, row_of
from gmijax.errors import ConfigError

BALL = ("env=ball_balance",)


def test_a_row_has_a_name_and_overrides():
    assert row_of("baseline") == Row("baseline", ())
    text = "no clip: algo.clip_value_loss=false 'algo.policy_hidden_layer_sizes=[64, 32]'"
    expected = ("algo.clip_value_loss=false", "algo.policy_hidden_layer_sizes=[64, 32]")
    assert row_of(text) == Row("no clip", expected)
    assert Row("apart, no clip", ()).folder == "apart-no-clip"


def test_bad_input_is_refused_before_anything_is_trained():
    for rows, message in (
        ([Row("a", ()), Row("a", ())], "--row a: two rows have this name"),
        ([Row("a", ("algo.clip_valu_loss=false",))], "clip_valu_loss"),
    ):
        with pytest.raises(ConfigError, match=message):
            checked(BALL, rows)
    assert checked(BALL, [Row("a", ("seed=1",))]) == "ball_balance"


def test_outcomes_are_of_the_jobs_that_ended_wherever_the_sweep_ran(tmp_path: Path):
    jobs = []
    for number, (state, final) in enumerate(
        [("completed", 0.95), ("completed", 0.5), ("failed", 1.0), ("interrupted", 1.0)]
    ):
        run = tmp_path / f"{number:03d}"
        run.mkdir()
        rewards = [1.0] * 20 + [final] * 20
        lines = [
            {"env_steps": k, "wall_s": k, "reward_per_step": one} for k, one in enumerate(rewards)
        ]
        (run / "metrics.jsonl").write_text("".join(f"{json.dumps(one)}\n" for one in lines))
        job = {"overrides": {"seed": str(number)}, "wall_s": 5.0, "state": state}
        jobs.append({**job, "run_dir": f"/elsewhere/{run.name}"})
    outcomes, unfinished = outcomes_of("ball_balance", tmp_path, {"jobs": jobs})
    assert [one.seed for one in outcomes] == ["0", "1", "2"]
    assert [one.succeeded for one in outcomes] == [True, False, False]
    assert unfinished == 1


def test_a_row_is_one_line_for_people():
    row = {"row": "a", "seeds": 2, "successes": 1, "wilson": [0.1, 0.9]}
    row |= {"final": [0.1, 0.2, 0.3], "peak": None, "return": None}
    assert line(row) == "a: 1 of 2 (10% to 90%), final 0.2 (0.1 to 0.3)"
    compared = {**row, "p_successes": 1.0, "p_final": 0.5}
    assert line(compared).endswith("; p 1.0 for successes, 0.5 for final rewards")
    assert line({**row, "seeds": 0}) == "a: no training has ended"
