"""Layout, plan and planner: pure data and pure decisions."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from supervision import MPS, gpu, machine, planned

from gmijax.errors import BackendUnavailable, ConfigError
from gmijax.machine.snapshot import Machine
from gmijax.partition import reduction
from gmijax.partition.layout import Layout
from gmijax.partition.plan import Allocation, Plan
from gmijax.partition.shares import split_cores

ON_MPS = machine(1, mps_control=MPS)
NEW_DRIVER = machine(1, mps_control=MPS, driver_version="590.44")


def test_even_layout_numbers_gmis_gpu_by_gpu():
    layout = Layout.even(num_gpus=2, gmis_per_gpu=3)
    assert layout.gmis_of_gpu == ((0, 1, 2), (3, 4, 5))
    assert (layout.num_gpus, layout.num_gmis) == (2, 6)
    assert layout.gpu_of(4) == 1
    assert layout.neighbours_of(4) == (3, 4, 5)


@pytest.mark.parametrize("bad", [(), ((0,), ()), ((0, 0),), ((1, 2),), ((0, 2),)])
def test_layout_with_wrong_ids_is_refused(bad: tuple[tuple[int, ...], ...]):
    with pytest.raises(ConfigError, match=r"plan.layout="):
        Layout(bad)


@pytest.mark.parametrize("num_gpus", [0, 2])
def test_plan_survives_json(num_gpus: int):
    plan = planned(machine(num_gpus, mps_control=MPS), gpus=2, gmis_per_gpu=2)
    assert Plan.from_dict(json.loads(json.dumps(plan.to_dict()))) == plan


def test_a_plan_of_an_older_version_is_read():
    plan = planned(machine(2, mps_control=MPS), gpus=2, gmis_per_gpu=2)
    data = plan.to_dict()
    former = {"slices": data.pop("allocations"), "may_share": data.pop("allow_fallback"), **data}
    former["slices"] = [{**one, "priority": 0} for one in former["slices"]]
    assert Plan.from_dict(json.loads(json.dumps(former))) == plan


def test_plan_refuses_allocations_that_do_not_fit_the_layout():
    allocations = (Allocation(1, 0, "cpu", None, None, ()),)
    with pytest.raises(ConfigError, match="do not match layout"):
        Plan(Layout(((0,),)), allocations, "cpu", "tcg_ex", 8, "none", "host", ("trainer",))


def test_every_auto_has_a_reason_and_explicit_choices_have_none():
    plan = planned(machine(0), gmis_per_gpu=2)
    assert [reason.split()[0] for reason in plan.reasons] == [
        *("backend", "template", "strategy", "intra")
    ]
    # With one GMI no reason names a way of exchange.
    assert [reason.split()[0] for reason in planned(machine(0)).reasons] == [
        *("backend", "template", "strategy")
    ]
    explicit = planned(
        machine(0), {"strategy": "mpr"}, gmis_per_gpu=2, backend="cpu", template="tcg_ex"
    )
    assert [reason.split()[0] for reason in explicit.reasons] == ["intra"]


TWO = {"gmis_per_gpu": 2}
TWO_BY_TWO = {"gpus": 2, "gmis_per_gpu": 2}
UNEVEN = {"layout": ((0, 1), (2,))}
PAPER = {"strategy": "paper"}


@pytest.mark.parametrize(
    ("backend", "is_installed", "reduce", "changes", "strategy", "why"),
    [
        ("cpu", True, {}, {}, "none", "one GMI"),
        ("cpu", True, {}, TWO, "mpr", "(Algorithm 1)"),
        ("cpu", True, {}, TWO_BY_TWO, "mpr", "Algorithm 1 says mrr"),
        ("cpu", True, {}, UNEVEN, "mpr", "Algorithm 1 says har"),
        ("share", True, {}, TWO_BY_TWO, "one_shot", "GMIs that share"),
        ("share", True, {}, {"gmis_per_gpu": 3}, "one_shot", "GMIs that share"),
        ("share", True, {}, UNEVEN, "one_shot", "GMIs that share"),
        # One program trains on all GPUs.
        ("share", True, {}, {"gpus": 2}, "mrr", "(Algorithm 1)"),
        ("share", True, PAPER, TWO_BY_TWO, "mrr", "(Algorithm 1)"),
        ("share", True, PAPER, {"gmis_per_gpu": 3}, "mpr", "(Algorithm 1)"),
        ("share", False, {}, TWO, "mpr", "(Algorithm 1)"),
        ("share", False, {}, TWO_BY_TWO, "mpr", "Algorithm 1 says mrr"),
        ("share", False, {}, {"gpus": 2}, "mpr", "Algorithm 1 says mrr"),
        ("share", False, PAPER, TWO, "mpr", "(Algorithm 1)"),
        ("cpu", False, {}, TWO, "mpr", "(Algorithm 1)"),
    ],
)
def test_auto_exchanges_on_gpus_where_it_can_else_by_algorithm_1_and_says_why(
    backend: str,
    is_installed: bool,
    reduce: dict[str, Any],
    changes: dict[str, Any],
    strategy: str,
    why: str,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(reduction, "is_installed", lambda *_: is_installed)
    plan = planned(machine(0 if backend == "cpu" else 2), reduce, backend=backend, **changes)
    assert plan.strategy == strategy
    (reason,) = [text for text in plan.reasons if text.startswith("strategy")]
    assert reason.startswith(f"strategy {strategy}: ")
    assert why in reason
    # A plan that leaves the fast path says what would bring it.
    lacking = "one_shot would train faster: exchanges between GMIs on GPUs need the package cuda-b"
    assert (lacking in reason) == (backend == "share" and not is_installed and not reduce)
    on_gpu = backend == "share" and is_installed
    assert plan.intra == ("ipc" if on_gpu else "host")


@pytest.mark.parametrize(
    ("here", "plan", "message"),
    [
        (machine(1), {"gpus": 2}, "plan.gpus=2: this machine has 1 usable GPUs"),
        (machine(1), {"gpus": (0, 3)}, r"no usable GPU 3; usable are \[0\]"),
        (machine(1), {"layout": ((0,), (1,))}, "GPUs of plan.layout=2: this machine has 1"),
        (machine(2), {"gpus": (0,), "layout": ((0,), (1,))}, "plan.layout has 2 GPUs"),
        (machine(1), {"sm_percent": 50.0, "backend": "share"}, "only the mps backend"),
        (machine(0), {"sm_percent": 50.0}, "only the mps backend can cap SMs, the backend is cpu"),
        (machine(1), {"gmis_per_gpu": 2, "memory_fraction": 0.5}, "would reserve 1.00"),
        (ON_MPS, {"gmis_per_gpu": 49}, "MPS of driver 580.159.03 allows at most 48"),
        (NEW_DRIVER, {"gmis_per_gpu": 61}, "MPS of driver 590.44 allows at most 60"),
    ],
)
def test_values_that_do_not_fit_are_refused(here: Machine, plan: dict[str, Any], message: str):
    with pytest.raises(ConfigError, match=message):
        planned(here, **plan)


@pytest.mark.parametrize(
    ("here", "backend", "message"),
    [
        (machine(0), "mps", "no usable NVIDIA GPU here; available here: auto, cpu$"),
        (machine(0), "share", "no usable NVIDIA GPU here; available here: auto, cpu$"),
        (machine(1), "mps", "was not found in PATH .*available here: auto, cpu, share$"),
        (ON_MPS, "mig", "have no MIG; .*: auto, cpu, share, mps$"),
    ],
)
def test_backend_that_cannot_be_had_is_refused(here: Machine, backend: str, message: str):
    with pytest.raises(BackendUnavailable, match=message):
        planned(here, backend=backend)


def test_gpus_in_mig_mode_are_passed_over():
    here = machine(0, gpus=(gpu(0, mig_enabled=True), gpu(1), gpu(2)))
    plan = planned(here, gpus=1)
    assert plan.allocations[0].device == gpu(1).uuid
    assert "GPUs [1]: not [0], which are in MIG mode" in plan.reasons
    assert [allocation.device for allocation in planned(here, gpus=2).allocations] == [
        gpu(1).uuid,
        gpu(2).uuid,
    ]
    with pytest.raises(BackendUnavailable, match="GPU 0 is in MIG mode"):
        planned(here, gpus=3)


def test_memory_is_split_over_the_gmis_of_a_gpu_and_gpus_can_be_chosen_by_index():
    plan = planned(machine(3), gpus=(2, 0), layout=((0, 1), (2,)))
    assert [allocation.memory_fraction for allocation in plan.allocations] == [0.4, 0.4, 0.8]
    assert [allocation.device for allocation in plan.allocations] == [
        gpu(2).uuid,
        gpu(2).uuid,
        gpu(0).uuid,
    ]


def test_any_number_of_gpus_is_virtual_on_cpu():
    plan = planned(machine(1, cpu_cores=(0, 1)), gpus=4, gmis_per_gpu=2, backend="cpu")
    assert plan.layout.num_gmis == 8
    assert [allocation.cpus for allocation in plan.allocations] == [(0,), (1,)] * 4
    assert {allocation.device for allocation in plan.allocations} == {"cpu"}


@given(st.sets(st.integers(0, 200), min_size=1), st.integers(1, 40))
def test_cores_are_disjoint_complete_and_even(cores: set[int], num_gmis: int):
    split = split_cores(sorted(cores), num_gmis)
    assert len(split) == num_gmis
    if len(cores) >= num_gmis:
        assert [core for part in split for core in part] == sorted(cores)
        sizes = [len(part) for part in split]
        assert max(sizes) - min(sizes) <= 1
    else:
        assert {core for part in split for core in part} == cores
