"""MIG: what NVML lists, which GMI gets which instance, what the backend does with them."""

from __future__ import annotations

from pathlib import Path

import fake_nvml
import pytest
from fake_nvml import machine_of
from supervision import MPS, planned

from gmijax.errors import BackendUnavailable, ConfigError
from gmijax.machine.mig_split import place_instances, split_commands
from gmijax.machine.nvidia import Gpu
from gmijax.machine.snapshot import visible_gpus
from gmijax.partition.shares import assign_instances
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends import open_backend
from gmijax.supervise.environment import gmi_environment


def test_cuda_visible_devices_may_name_instances(monkeypatch: pytest.MonkeyPatch):
    gpus = machine_of(monkeypatch, fake_nvml.A100_SEVEN, fake_nvml.H200_MIXED).gpus
    first, mixed = (fake_nvml.instance_uuid(0, place) for place in (4, 2)), gpus[1].instances[0]
    seen = visible_gpus(gpus, ",".join([*first, mixed.uuid, "MIG-none", "0"]))
    assert [gpu.index for gpu in seen] == [0, 1]
    assert [one.uuid for one in seen[0].instances] == [
        fake_nvml.instance_uuid(0, 4),
        fake_nvml.instance_uuid(0, 2),
    ]
    assert seen[1].instances == (mixed,)
    assert visible_gpus(gpus, "GPU-0") == (gpus[0],)


@pytest.mark.parametrize(
    ("num_sms", "num_gmis", "places"),
    [
        ((14,) * 7, 3, (0, 1, 2)),
        ((16, 60, 32, 16), 2, (1, 2)),
        ((16, 60, 32, 16), 4, (1, 2, 0, 3)),
        ((16, 60, 32, 16), 6, (1, 2, 0, 3, 1, 1)),
        ((42,), 3, (0, 0, 0)),
    ],
)
def test_every_gmi_gets_an_instance_of_its_own_while_there_are_any(
    num_sms: tuple[int, ...], num_gmis: int, places: tuple[int, ...]
):
    assert assign_instances(num_sms, num_gmis) == places


def test_plan_over_uneven_instances(monkeypatch: pytest.MonkeyPatch):
    here = machine_of(monkeypatch, fake_nvml.H200_MIXED)
    plan = planned(here, gmis_per_gpu=4, backend="mig")
    sizes = {one.uuid: one.profile for one in here.gpus[0].instances}
    assert [sizes[allocation.device] for allocation in plan.allocations] == [
        *("3g.71gb", "2g.35gb", "1g.18gb", "1g.18gb")
    ]
    assert {allocation.memory_fraction for allocation in plan.allocations} == {0.8}
    assert (plan.strategy, plan.intra) == ("mpr", "host")


def test_gmis_that_share_instances_split_memory_and_need_mps(monkeypatch: pytest.MonkeyPatch):
    here = machine_of(monkeypatch, fake_nvml.A100_HALVES)
    plan = planned(here, gmis_per_gpu=3, backend="mig")
    assert [allocation.memory_fraction for allocation in plan.allocations] == [0.8, 0.4, 0.4]
    with pytest.raises(BackendUnavailable, match=r"3 MIG instances for 4 GMIs, and MPS"):
        planned(here, gmis_per_gpu=4, backend="mig")
    here = machine_of(monkeypatch, fake_nvml.A100_SEVEN, mps_control=MPS)
    assert planned(here, gmis_per_gpu=42, backend="mig").layout.num_gmis == 42
    with pytest.raises(ConfigError, match=r"at most 6 processes on a MIG instance 1g\.10gb"):
        planned(here, gmis_per_gpu=43, backend="mig")
    with pytest.raises(ConfigError, match="2 GMIs on MIG-"):
        planned(here, gmis_per_gpu=8, backend="mig", memory_fraction=0.5)


@pytest.mark.parametrize(
    ("board", "why"),
    [
        (fake_nvml.H200_MIG_EMPTY, "MIG mode is on, but there are no instances"),
        (fake_nvml.H200_MIG_OFF, r"no GPU is divided .*gmijax doctor mig="),
        (fake_nvml.V100, "the GPUs here have no MIG"),
    ],
)
def test_mig_without_instances_is_refused(
    monkeypatch: pytest.MonkeyPatch, board: fake_nvml.Board, why: str
):
    with pytest.raises(BackendUnavailable, match=f"plan.backend=mig: {why}"):
        planned(machine_of(monkeypatch, board), backend="mig")


def test_rings_between_instances_are_refused_and_not_chosen(monkeypatch: pytest.MonkeyPatch):
    here = machine_of(monkeypatch, fake_nvml.A100_SEVEN, fake_nvml.H200_MIXED)
    two_by_two = {"gpus": 2, "gmis_per_gpu": 2, "backend": "mig"}
    assert planned(here, **two_by_two).strategy == "mpr"
    with pytest.raises(ConfigError, match=r"mrr: .*: rings between MIG instances"):
        planned(here, {"strategy": "mrr"}, **two_by_two)


def test_a_gmi_sees_its_instance_and_no_daemon(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    here = machine_of(monkeypatch, fake_nvml.A100_SEVEN)
    plan = planned(here, gmis_per_gpu=2, backend="mig")
    with open_backend(plan, here, RunPaths(tmp_path)) as backend:
        found = gmi_environment(plan, 1, {}, tmp_path, backend.environment(1))
        backend.verify({0: 1, 1: 2})
        backend.terminate(0, [1])
    assert found["CUDA_VISIBLE_DEVICES"] == fake_nvml.instance_uuid(0, 1)
    assert found["XLA_CLIENT_MEM_FRACTION"] == "0.8"
    assert list(Path(found["CUDA_MPS_PIPE_DIRECTORY"]).iterdir()) == []
    gone = machine_of(monkeypatch, fake_nvml.H200_MIXED)
    with pytest.raises(BackendUnavailable, match="of GMI 0 does not exist"):
        open_backend(plan, gone, RunPaths(tmp_path))


def board(name: str, memory_mib: int) -> Gpu:
    return Gpu(0, "GPU-0", name, memory_mib, (9, 0), mig_enabled=False, mig_supported=True)


@pytest.mark.parametrize(
    ("name", "memory_mib", "wanted", "profiles"),
    [
        ("NVIDIA H200", 143771, "1g,3g,2g,1g", "3g.71gb:4,2g.35gb:2,1g.18gb:1,1g.18gb:0"),
        ("NVIDIA A100-SXM4-80GB", 81920, "3g.40gb,4g.40gb", "4g.40gb:0,3g.40gb:4"),
        ("NVIDIA A100-SXM4-40GB", 40960, "7g", "7g.40gb:0"),
        ("NVIDIA H100 80GB HBM3", 81559, "2g,2g,2g,1g", "2g.20gb:4,2g.20gb:2,2g.20gb:0,1g.10gb:6"),
        ("NVIDIA A30", 24576, "2g,1g,1g", "2g.12gb:2,1g.6gb:1,1g.6gb:0"),
    ],
)
def test_commands_of_a_split(name: str, memory_mib: int, wanted: str, profiles: str):
    assert split_commands(board(name, memory_mib), wanted) == (
        "sudo nvidia-smi -i 0 -mig 1",
        f"sudo nvidia-smi mig -i 0 -cgi {profiles} -C",
        "nvidia-smi -L",
    )


def test_old_instances_are_destroyed_first(monkeypatch: pytest.MonkeyPatch):
    [gpu] = machine_of(monkeypatch, fake_nvml.A100_SEVEN).gpus
    destroy = "sudo nvidia-smi mig -i 0 "
    assert split_commands(gpu, "7g")[:2] == (f"{destroy}-dci", f"{destroy}-dgi")


@pytest.mark.parametrize(
    ("wanted", "why"),
    [
        *((text, "do not fit side by side") for text in ("3g,3g,1g", "7g,1g", "4g,4g")),
        ("1g,1g,1g,1g,1g,1g,1g,1g", "do not fit side by side"),
        *((text, "expected a list of 1g, 2g, 3g, 4g, 7g") for text in ("5g", "big", "1g,,1g")),
        ("1g.5tb", "expected a list of"),
        # Another profile of the same size is not mistaken.
        ("3g.71gb,1g.35gb", r"1g\.35gb is not supported; 1g of .* is 1g\.18gb"),
    ],
)
def test_a_split_that_cannot_be_is_refused(wanted: str, why: str):
    with pytest.raises(ConfigError, match=why):
        split_commands(board("NVIDIA H200", 143771), wanted)


def test_instances_do_not_overlap():
    sizes = {1: 1, 2: 2, 3: 4, 4: 4}
    for parts in ((4, 3), (3, 2, 1, 1), (2, 2, 2, 1), (4, 2, 1), (3, 2, 2), (1,) * 7):
        starts = place_instances(parts)
        assert starts is not None
        cells = [
            cell
            for part, start in zip(parts, starts, strict=True)
            for cell in range(start, start + sizes[part])
        ]
        assert len(cells) == len(set(cells))
        assert max(cells) < 8
