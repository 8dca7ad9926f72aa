"""A job that measures the strategies first, and trains with the fastest."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from training_jobs import POINT, STEPS, train


@pytest.mark.timeout(300)
def test_measured_once_and_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    job = (*POINT, "plan.gmis_per_gpu=2", f"num_timesteps={2 * STEPS}")
    done = train(*job, "reduce.selection=measured", "run.dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())["plan"]
    seconds = summary["selection"]["seconds"]
    assert set(seconds) == {"mpr", "har+host"}
    assert all(0 < value < 10 for value in seconds.values())
    fastest = min(seconds, key=seconds.__getitem__)
    assert summary["selection"]["measured"] == fastest
    assert summary["strategy"] == fastest.partition("+")[0]
    assert "Algorithm 1 says mpr" in done.stdout
    (kept,) = (tmp_path / "cache" / "gmijax" / "reduction").iterdir()
    assert set(json.loads(kept.read_text())) == set(seconds)
