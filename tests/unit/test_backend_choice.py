"""Which backend a job gets by default, and why it says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import fake_nvml
import pytest
from fake_nvml import A100_SEVEN, H200_MIG_EMPTY, H200_MIG_OFF, V100, Board, machine_of
from supervision import MPS

from gmijax.config import PlanConfig, ReduceConfig
from gmijax.errors import BackendUnavailable
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan

P100 = Board("Tesla P100-SXM2-16GB", 16384, (6, 0))
EXCLUSIVE, PROHIBITED = (H200_MIG_OFF._replace(compute_mode=mode) for mode in (3, 2))


def planned(
    monkeypatch: pytest.MonkeyPatch,
    boards: tuple[Board, ...],
    control: Path | None = MPS,
    make: dict[str, Any] | None = None,
    **changes: Any,
) -> Plan:
    daemon = Path("/tmp/nvidia-mps") if V100 in boards else None
    here = machine_of(monkeypatch, *boards, mps_control=control, operator_daemon=daemon)
    config = PlanConfig(**{"gmis_per_gpu": 2, **changes})
    return make_plan(config, ReduceConfig(), 64, here, **(make or {}))


SERVE = {"template": "tcg"}


@pytest.mark.parametrize(
    ("boards", "control", "make", "backend", "why"),
    [
        ((H200_MIG_OFF,), MPS, {}, "mps", "with a daemon of its own, and can exchange gradients"),
        ((H200_MIG_OFF,), MPS, SERVE, "mps", "no MIG instances to keep them apart"),
        ((H200_MIG_OFF, A100_SEVEN), MPS, {}, "mps", "and can exchange gradients"),
        ((H200_MIG_OFF, A100_SEVEN), MPS, SERVE, "mig", "serving needs no exchange"),
        ((A100_SEVEN,), MPS, {}, "mig", "in MIG mode; MPS on a whole GPU would"),
        ((V100,), MPS, SERVE, "mps", "the daemon that runs here; compute capability 7.0 has"),
        ((P100,), MPS, {}, "share", "warning: MPS of a GPU of compute capability 6.0"),
        ((H200_MIG_OFF,), None, {}, "share", "warning: .*not installed.* 1.45 to 4.73 times"),
        ((), None, SERVE, "cpu", "GPUs are virtual"),
    ],
)
def test_backend_by_need(
    monkeypatch: pytest.MonkeyPatch,
    boards: tuple[Board, ...],
    control: Path | None,
    make: dict[str, Any],
    backend: str,
    why: str,
):
    plan = planned(monkeypatch, boards, control, make)
    assert plan.backend == backend
    with pytest.raises(AssertionError, match=why):
        raise AssertionError(plan.reasons[0])


def test_mig_serves_on_the_gpus_that_have_instances(monkeypatch: pytest.MonkeyPatch):
    plan = planned(monkeypatch, (H200_MIG_OFF, H200_MIG_EMPTY, A100_SEVEN), make=SERVE)
    assert [allocation.device for allocation in plan.allocations] == [
        fake_nvml.instance_uuid(0, place) for place in (0, 1)
    ]
    assert "GPUs [2]: not [0], which have no MIG instance" in plan.reasons


def test_one_serving_gmi_takes_a_whole_gpu(monkeypatch: pytest.MonkeyPatch):
    plan = planned(monkeypatch, (A100_SEVEN, H200_MIG_OFF), make=SERVE, gmis_per_gpu=1)
    assert (plan.backend, plan.allocations[0].device) == ("share", "GPU-1-uuid")
    assert "nothing to share" in plan.reasons[0]


@pytest.mark.parametrize(
    ("neighbours", "backend"), [("GPU-0-uuid", "mps"), ("GPU-7-uuid", "share")]
)
def test_one_gmi_is_a_client_of_the_daemon_that_its_pack_has_for_the_gpu(
    monkeypatch: pytest.MonkeyPatch, neighbours: str, backend: str
):
    here = machine_of(monkeypatch, H200_MIG_OFF, mps_control=MPS, daemons={neighbours: Path("/d")})
    plan = make_plan(PlanConfig(), ReduceConfig(), 64, here)
    assert plan.backend == backend


@pytest.mark.parametrize(
    ("boards", "changes", "why"),
    [
        ((H200_MIG_EMPTY,), {}, "GPU 0 is in MIG mode, .* it has no instance"),
        ((A100_SEVEN,), {"backend": "share"}, "all GPUs are in MIG mode; available here: auto, "),
        ((A100_SEVEN, V100), {"backend": "mps", "gpus": (0,)}, "GPU 0 .* use plan.backend=mig"),
        ((EXCLUSIVE,), {"backend": "share"}, "EXCLUSIVE_PROCESS, so without MPS it takes one"),
        ((PROHIBITED,), {}, "GPU 0 is in compute mode PROHIBITED"),
    ],
)
def test_gpus_that_cannot_be_used_so_are_refused(
    monkeypatch: pytest.MonkeyPatch, boards: tuple[Board, ...], changes: dict[str, Any], why: str
):
    with pytest.raises(BackendUnavailable, match=why):
        planned(monkeypatch, boards, **changes)


@pytest.mark.parametrize(
    ("boards", "changes", "may"),
    [
        ((H200_MIG_OFF,), {}, True),
        ((H200_MIG_OFF,), {"backend": "mps"}, False),
        ((H200_MIG_OFF,), {"sm_percent": 50.0}, False),
        ((EXCLUSIVE,), {}, False),
        ((V100,), {"gmis_per_gpu": 1}, False),
    ],
)
def test_what_may_fall_back_to_taking_turns(
    monkeypatch: pytest.MonkeyPatch, boards: tuple[Board, ...], changes: dict[str, Any], may: bool
):
    assert planned(monkeypatch, boards, **changes).allow_fallback == may
