"""Layout, plan and planner: pure data and pure decisions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from supervision import gpu, machine, plan_config, reduce_config

from gmijax.errors import BackendUnavailable, ConfigError
from gmijax.machine.snapshot import Machine
from gmijax.partition import reduction
from gmijax.partition.layout import Layout
from gmijax.partition.plan import Plan, Slice
from gmijax.partition.planner import make_plan, split_cores

MPS = Path("/usr/bin/nvidia-cuda-mps-control")


def planned(here: Machine, reduce: dict[str, Any] | None = None, **changes: Any) -> Plan:
    return make_plan(plan_config(**changes), reduce_config(**(reduce or {})), 64, here)


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


def test_plan_refuses_slices_that_do_not_fit_the_layout():
    slices = (Slice(1, 0, "cpu", None, None, ()),)
    with pytest.raises(ConfigError, match="do not match layout"):
        Plan(Layout(((0,),)), slices, "cpu", "tcg_ex", 8, "none", "host")


def test_running_daemon_is_named_in_the_reason():
    here = machine(1, mps_control=MPS, operator_daemon=Path("/tmp/nvidia-mps"))
    assert "the daemon that runs here" in planned(here, gmis_per_gpu=2).reasons[0]


def test_every_auto_has_a_reason_and_explicit_choices_have_none():
    plan = planned(machine(0), gmis_per_gpu=2)
    assert [reason.split()[0] for reason in plan.reasons] == [
        *("backend", "template", "strategy", "intra")
    ]
    explicit = make_plan(
        plan_config(gmis_per_gpu=2, backend="cpu", template="tcg_ex"),
        reduce_config(strategy="mpr", intra="host"),
        64,
        machine(0),
    )
    assert explicit.reasons == ()


@pytest.mark.parametrize(
    ("changes", "strategy", "why"),
    [
        ({}, "none", "one GMI"),
        ({"gmis_per_gpu": 2}, "mpr", "(Algorithm 1)"),
        ({"gpus": 2, "gmis_per_gpu": 2}, "mpr", "Algorithm 1 says mrr"),
        ({"gpus": 2, "gmis_per_gpu": 3}, "mpr", "Algorithm 1 says har"),
        ({"layout": ((0, 1), (2,))}, "mpr", "Algorithm 1 says har"),
    ],
)
def test_auto_tells_what_algorithm_1_says_and_keeps_to_host_memory(
    changes: dict[str, Any], strategy: str, why: str
):
    plan = planned(machine(0), **changes)
    assert plan.strategy == strategy
    (reason,) = [text for text in plan.reasons if text.startswith("strategy")]
    assert reason.startswith(f"strategy {strategy}: ")
    assert why in reason


@pytest.mark.parametrize(
    ("changes", "selection", "strategy"),
    [
        ({"gpus": 2, "gmis_per_gpu": 2}, "device", "one_shot"),
        ({"gmis_per_gpu": 3}, "device", "one_shot"),
        ({"layout": ((0, 1), (2,))}, "device", "one_shot"),
        # One program trains on all GPUs.
        ({"gpus": 2}, "device", "mrr"),
        ({"gpus": 2, "gmis_per_gpu": 2}, "paper", "mrr"),
        ({"gmis_per_gpu": 3}, "paper", "mpr"),
    ],
)
@pytest.mark.parametrize("is_installed", [True, False])
def test_gmis_that_share_a_gpu_exchange_on_it_where_they_can(
    changes: dict[str, Any],
    selection: str,
    strategy: str,
    is_installed: bool,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(reduction, "_is_installed", lambda *_: is_installed)
    by_paper = planned(machine(2), {"selection": "paper"}, backend="share", **changes).strategy
    assert is_installed or by_paper == "mpr"
    plan = planned(machine(2), {"selection": selection}, backend="share", **changes)
    assert plan.strategy == (strategy if is_installed else by_paper)
    (reason,) = [text for text in plan.reasons if text.startswith("strategy")]
    assert ("one_shot: GMIs that share" in reason) == (is_installed and strategy == "one_shot")
    assert "Algorithm 1" in reason
    assert plan.intra == ("ipc" if is_installed else "host")


@pytest.mark.parametrize(
    ("reduce", "changes", "backend", "is_told"),
    [
        ({}, {"gmis_per_gpu": 2}, "share", True),
        ({}, {"gmis_per_gpu": 2, "gpus": 2}, "share", True),
        ({"selection": "paper"}, {"gmis_per_gpu": 2}, "share", False),
        ({"intra": "host"}, {"gmis_per_gpu": 2}, "share", False),
        ({}, {"gpus": 2}, "share", True),  # There are no rings either.
        ({}, {"gmis_per_gpu": 2}, "cpu", False),
    ],
)
def test_a_plan_that_leaves_the_fast_path_says_what_would_bring_it(
    reduce: dict[str, Any],
    changes: dict[str, Any],
    backend: str,
    is_told: bool,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(reduction, "_is_installed", lambda *_: False)
    plan = planned(machine(2), {"selection": "device"} | reduce, backend=backend, **changes)
    (reason,) = [text for text in plan.reasons if text.startswith("strategy")]
    lacking = "one_shot would train faster: exchanges between GMIs on GPUs need the package cuda-b"
    assert (lacking in reason) == is_told


def test_who_wants_host_memory_gets_what_algorithm_1_says(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reduction, "_is_installed", lambda *_: True)
    reduce = {"selection": "device", "intra": "host"}
    plan = planned(machine(1), reduce, backend="share", gmis_per_gpu=2)
    assert (plan.strategy, plan.intra) == ("mpr", "host")


@pytest.mark.parametrize(
    ("reduce", "changes", "message"),
    [
        (
            {"strategy": "mrr"},
            {"layout": ((0, 1), (2,))},
            r"mrr: .* \[\[0,1\],\[2\]\]: every",
        ),
        ({"strategy": "flat"}, {"gpus": 2, "gmis_per_gpu": 2}, r"flat: .*NCCL before 2\.30"),
        ({"intra": "ipc"}, {"gmis_per_gpu": 2}, r"intra=ipc: .*\[\[0,1\]\]: CUDA IPC needs"),
    ],
)
def test_a_reduction_that_cannot_run_is_refused(
    reduce: dict[str, Any], changes: dict[str, Any], message: str
):
    with pytest.raises(ConfigError, match=message):
        make_plan(plan_config(**changes), reduce_config(**reduce), 64, machine(0))


@pytest.mark.parametrize(
    ("here", "changes", "message"),
    [
        (machine(1), {"gpus": 2}, "plan.gpus=2: this machine has 1 usable GPUs"),
        (machine(1), {"gpus": (0, 3)}, r"no usable GPU 3; usable are \[0\]"),
        (machine(1), {"layout": ((0,), (1,))}, "GPUs of plan.layout=2: this machine has 1"),
        (machine(2), {"gpus": (0,), "layout": ((0,), (1,))}, "plan.layout has 2 GPUs"),
        (machine(1), {"sm_percent": 50.0, "backend": "share"}, "only the mps backend"),
        (machine(0), {"sm_percent": 50.0}, "only the mps backend can cap SMs, the backend is cpu"),
        (machine(1), {"gmis_per_gpu": 2, "memory_fraction": 0.5}, "would reserve 1.00"),
        (
            machine(1, mps_control=MPS),
            {"gmis_per_gpu": 49},
            "MPS of driver 580.159.03 allows at most 48",
        ),
    ],
)
def test_values_that_do_not_fit_are_refused(here: Machine, changes: dict[str, Any], message: str):
    with pytest.raises(ConfigError, match=message):
        planned(here, **changes)


@pytest.mark.parametrize(
    ("here", "backend", "message"),
    [
        (machine(0), "mps", "no usable NVIDIA GPU here; available here: auto, cpu$"),
        (machine(0), "share", "no usable NVIDIA GPU here; available here: auto, cpu$"),
        (machine(1), "mps", "was not found in PATH .*available here: auto, cpu, share$"),
        (machine(1, mps_control=MPS), "mig", "have no MIG; .*: auto, cpu, share, mps$"),
    ],
)
def test_backend_that_cannot_be_had_is_refused(here: Machine, backend: str, message: str):
    with pytest.raises(BackendUnavailable, match=message):
        planned(here, backend=backend)


def test_gpus_in_mig_mode_are_passed_over():
    here = machine(0, gpus=(gpu(0, mig_enabled=True), gpu(1), gpu(2)))
    plan = planned(here, gpus=1)
    assert plan.slices[0].device == gpu(1).uuid
    assert "GPUs [1]: not [0], which are in MIG mode" in plan.reasons
    assert [share.device for share in planned(here, gpus=2).slices] == [gpu(1).uuid, gpu(2).uuid]
    with pytest.raises(BackendUnavailable, match="GPU 0 is in MIG mode"):
        planned(here, gpus=3)


def test_new_drivers_allow_more_clients():
    here = machine(1, mps_control=MPS, driver_version="590.44")
    assert planned(here, gmis_per_gpu=60).layout.num_gmis == 60
    with pytest.raises(ConfigError, match="at most 60"):
        planned(here, gmis_per_gpu=61)


def test_memory_is_split_over_the_gmis_of_a_gpu():
    plan = planned(machine(2), layout=((0, 1), (2,)))
    assert [share.memory_fraction for share in plan.slices] == [0.4, 0.4, 0.8]
    assert [share.device for share in plan.slices] == [gpu(0).uuid, gpu(0).uuid, gpu(1).uuid]


def test_gpus_can_be_chosen_by_index():
    plan = planned(machine(3), gpus=(2, 0))
    assert [share.device for share in plan.slices] == [gpu(2).uuid, gpu(0).uuid]


def test_any_number_of_gpus_is_virtual_on_cpu():
    plan = planned(machine(1, cpu_cores=(0, 1)), gpus=4, gmis_per_gpu=2, backend="cpu")
    assert plan.layout.num_gmis == 8
    assert [share.cpus for share in plan.slices] == [(0,), (1,)] * 4
    assert {share.device for share in plan.slices} == {"cpu"}


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
