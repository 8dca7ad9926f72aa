"""SM caps and memory fractions of GMIs, and which caps are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from supervision import MPS, gpu, machine
from supervision import planned as plan_of

from gmijax.errors import ConfigError
from gmijax.partition.plan import Plan
from gmijax.partition.shares import is_clean

MEASURED = Path(__file__).parents[2] / "tests/golden/sm_caps_h200.json"
AMPERE = (gpu(0)._replace(compute_capability=(8, 0)),)


def planned(gmis_per_gpu: int = 2, **changes: Any) -> Plan:
    here = machine(1, mps_control=MPS, **changes.pop("here", {}))
    return plan_of(here, gmis_per_gpu=gmis_per_gpu, **changes)


def caps(plan: Plan) -> list[float | None]:
    return [allocation.sm_percent for allocation in plan.allocations]


def test_every_gmi_can_have_its_own_share_and_none_is_the_default():
    assert caps(planned()) == [None, None]
    plan = planned(sm_percent=(50.0, 25.0), memory_fraction=(0.5, 0.2))
    assert caps(plan) == [50.0, 25.0]
    assert [allocation.memory_fraction for allocation in plan.allocations] == [0.5, 0.2]


@pytest.mark.parametrize("key", ["sm_percent", "memory_fraction"])
def test_one_value_per_gmi_or_one_for_all(key: str):
    with pytest.raises(ConfigError, match=rf"plan\.{key}=\[1,1\]: 2 values for 3 GMIs"):
        planned(3, **{key: (1.0, 1.0)})


@pytest.mark.parametrize(
    ("gmis_per_gpu", "cap"), [(1, 100.0), (2, 50.0), (3, 47.0), (4, 25.0), (5, 23.0), (8, 12.5)]
)
def test_even_shares_keep_clear_of_bad_values_on_hopper(gmis_per_gpu: int, cap: float):
    assert caps(planned(gmis_per_gpu, sm_percent="even")) == [cap] * gmis_per_gpu
    plain = planned(gmis_per_gpu, sm_percent="even", here={"gpus": AMPERE})
    assert caps(plain) == [round(100 / gmis_per_gpu, 1)] * gmis_per_gpu


@pytest.mark.parametrize("percent", [14.0, 20.0, 33.0, 46.0, 66.0, 89.9])
def test_bad_values_are_refused_on_hopper(percent: float):
    with pytest.raises(ConfigError, match=rf"{percent:g}: wrong .*docs/shares\.md; clean are"):
        planned(sm_percent=(50.0, percent))
    assert caps(planned(sm_percent=percent, here={"gpus": AMPERE})) == [percent] * 2


def test_no_cap_between_the_clean_ones_or_measured_to_be_wrong_counts_as_clean():
    assert [percent for percent in range(1, 101) if is_clean(percent)] == [
        *range(1, 14), *range(23, 28), *range(47, 52), *range(90, 101)
    ]  # fmt: skip
    assert is_clean(12.5)
    assert not is_clean(13.5)
    rows = json.loads(MEASURED.read_text())["rows"]
    wrong = [
        row["sm_percent"] for row in rows if any(product["wrong"] for product in row["products"])
    ]
    assert wrong
    assert [percent for percent in wrong if is_clean(percent)] == []


@pytest.mark.parametrize(
    ("changes", "checked"),
    [
        ({}, False),
        ({"sm_percent": 100.0}, False),
        ({"sm_percent": (100.0, 50.0)}, True),
        ({"sm_percent": 50.0, "self_check": "off"}, False),
        ({"self_check": "on"}, True),
        ({"backend": "cpu", "self_check": "on"}, True),
        # A daemon of somebody else may limit its clients without saying so.
        ({"here": {"operator_daemon": Path("/run/mps")}}, True),
        ({"here": {"operator_daemon": Path("/run/mps")}, "self_check": "off"}, False),
        ({"here": {"operator_daemon": Path("/run/mps")}, "backend": "share"}, False),
    ],
)
def test_products_are_checked_where_sms_are_or_may_be_capped(
    changes: dict[str, Any], checked: bool
):
    assert planned(**changes).self_check == checked
