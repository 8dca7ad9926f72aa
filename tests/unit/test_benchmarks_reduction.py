"""What `benchmarks.reduction` measures on a layout, without measuring anything."""

from __future__ import annotations

from typing import Any

import pytest
from supervision import MPS, machine, planned

from benchmarks.reduction_jobs import candidates
from gmijax.partition import reduction


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"gmis_per_gpu": 2}, ["mpr", "har+host", "har+ipc"]),
        ({"gmis_per_gpu": 2, "backend": "cpu"}, ["mpr", "har+host"]),
        ({"gpus": 2, "gmis_per_gpu": 2}, ["mpr", "mrr", "har+host", "har+ipc", "one_shot"]),
    ],
)
def test_everything_that_can_run_is_measured_once(
    changes: dict[str, Any], names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reduction, "is_installed", lambda *_: True)
    plan = planned(machine(2, mps_control=MPS), **changes)
    assert [probe.name for probe in candidates(plan, 100)] == names
