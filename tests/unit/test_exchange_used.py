"""What the summary says where the exchange is not the plan's."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from supervision import machine
from supervision import planned as make_plan

from gmijax.workers.training_worker import exchange_used


@pytest.mark.parametrize(
    ("planned", "strategy", "intra", "used"),
    [
        ("mpr", "mpr", "host", {}),
        ("one_shot", "one_shot", "ipc", {}),
        ("one_shot", "mpr", "host", {"strategy": "mpr", "intra": "host"}),
        ("har", "har", "ipc", {"intra": "ipc"}),
        ("har", "har", "host", {"intra": "host"}),
    ],
)
def test_a_fall_back_to_host_memory_is_reported(
    planned: str,
    strategy: str,
    intra: str,
    used: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gmijax.partition.reduction.is_installed", lambda *_: True)
    plan = make_plan(machine(1), {"strategy": planned}, gmis_per_gpu=2, backend="share")
    comm: Any = SimpleNamespace(strategy=strategy, intra=intra, inter=None)
    assert exchange_used(plan, comm) == used
    # On several nodes also how these exchange.
    comm.inter = "tcp"
    assert exchange_used(plan, comm) == used | {"inter": "tcp"}
