"""How the benchmark of seeds reads its rows, and what it keeps of a sweep."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import records
from benchmarks.evaluation.page import TABLES
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
    jobs.append({**jobs[-1], "run_dir": "/elsewhere/004"})  # It was not begun.
    outcomes, cut = outcomes_of("ball_balance", tmp_path, {"jobs": jobs})
    assert [one.seed for one in outcomes] == ["0", "1", "2"]
    assert [one.succeeded for one in outcomes] == [True, False, False]
    assert [(one.seed, one.succeeded, one.curve[-1][0]) for one in cut] == [("3", False, 39)]


def test_a_row_is_one_line_for_people():
    row = {"row": "a", "seeds": 2, "successes": 1, "wilson": [0.1, 0.9]}
    row |= {"final": [0.1, 0.2, 0.3], "peak": None, "return": None}
    assert line(row) == "a: 1 of 2 (10% to 90%), final 0.2 (0.1 to 0.3)"
    compared = {**row, "p_successes": 1.0, "p_final": 0.5}
    assert line(compared).endswith("; p 1.0 for successes, 0.5 for final rewards")
    assert line({**row, "seeds": 0}) == "a: no training has ended"


def test_algorithms_stand_beside_the_first_whose_returns_are_the_mark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def row(name: str, overrides: list[str], more: float, *finals: float) -> dict[str, Any]:
        each = [
            {
                "final_return": final,
                "curve": [[0, 1.0, None], [2e6, 11.0, final / 2], [2e6 + more, 21.0, final]],
            }
            for final in finals
        ]
        found = {"row": name, "overrides": overrides, "seeds": 2, "successes": 2, "each": each[:2]}
        return {
            **found,
            "unfinished": len(each[2:]),
            "cut": each[2:],
            "return": [1.0, 100.0, 200.0],
        }

    rows = [row("PPO", [], 2e6, 80.0, 120.0), row("SAC", ["algo=sac"], 1e6, 200.0, 50.0, 89.0)]
    calls = [{"date": "2026-11-28", "results": {"task": "ant", "rows": rows}}]
    path = tmp_path / "seeds-ant-nvidia-h200.json"
    path.write_text(json.dumps({"format": 2, "calls": calls}))
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    ppo, sac = TABLES["returns"]()[2:4]
    # Nine tenths of 100: one of PPO's gets there at its end, one of SAC's at half of it. Within
    # the 3M steps of SAC's, PPO's have half their returns; they take as many seconds.
    ppo_returns = "100 (80 to 120, n=2) | 50 (40 to 60, n=2) | 100 (80 to 120, n=2)"
    assert ppo == f"| `ant` | PPO | 4 | 2 of 2 | {ppo_returns} | 90 | 1 of 2 | 20 |"
    sac_returns = " | ".join(["89 (50 to 200, n=3)"] * 3)
    assert sac == f"| `ant` | SAC | 3 | 2 of 3 | {sac_returns} | 90 | 1 of 3 | 10 |"
    assert TABLES["seeds"]() == ["not measured"]
