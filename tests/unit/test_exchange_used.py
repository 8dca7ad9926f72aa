"""What the summary says where the exchange is not the plan's."""

from __future__ import annotations

import pytest
from fake_device_memory import one_shot_of_one
from supervision import machine, plan_config, reduce_config

from gmijax.collectives.build import SoloReducer
from gmijax.partition.planner import make_plan
from gmijax.workers.trainers import exchange_used


@pytest.mark.parametrize(
    ("strategy", "fell_back"),
    [("mpr", {}), ("har", {"intra": "host"}), ("one_shot", {"strategy": "mpr", "intra": "host"})],
)
def test_a_fall_back_to_host_memory_is_told(
    strategy: str, fell_back: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.partition.reduction._is_installed", lambda *_: True)
    reduce = reduce_config(strategy=strategy)
    plan = make_plan(plan_config(gmis_per_gpu=2, backend="share"), reduce, 64, machine(1))
    assert exchange_used(plan, SoloReducer(5)) == fell_back
    with one_shot_of_one(5) as on_device:
        expected = {"intra": "ipc"} if strategy == "har" else {}
        assert exchange_used(plan, on_device) == expected
