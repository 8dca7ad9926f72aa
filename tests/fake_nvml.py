"""NVML as it answers on real machines: what was listed there, behind the functions of pynvml."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple, NoReturn

import pynvml
import pytest

from gmijax.machine.nvidia import list_gpus
from gmijax.machine.snapshot import Machine

MIB = 2**20


class Instance(NamedTuple):
    """A MIG device: profile, GPU instance, SMs, memory in MiB, UUID."""

    profile: str
    gpu_instance: int
    num_sms: int
    memory_mib: int
    uuid: str


class Board(NamedTuple):
    """A GPU. `mig` is None without MIG, else places of instances, None for a hole."""

    name: str
    memory_mib: int
    capability: tuple[int, int]
    mig: tuple[Instance | None, ...] | None = None
    mig_on: bool = False
    compute_mode: int = pynvml.NVML_COMPUTEMODE_DEFAULT


def instance_uuid(board: int, place: int) -> str:
    return f"MIG-{board}{place}d7a5e0-5f3c-5b1e-9c51-0242ac1100{place:02d}"


# nvidia-smi -L: NVIDIA A100-SXM4-80GB, seven MIG 1g.10gb Devices 0 to 6; GPU instances 7 to 13.
A100_SEVEN = Board(
    "NVIDIA A100-SXM4-80GB",
    81920,
    (8, 0),
    tuple(Instance("1g.10gb", 7 + i, 14, 9728, instance_uuid(0, i)) for i in range(7)),
    mig_on=True,
)
# An H200 that was divided as 3g, 2g, 1g, 1g after other instances were destroyed: holes.
H200_MIXED = Board(
    "NVIDIA H200",
    143771,
    (9, 0),
    (
        Instance("3g.71gb", 2, 60, 71424, instance_uuid(1, 0)),
        Instance("2g.35gb", 5, 32, 35712, instance_uuid(1, 1)),
        None,
        Instance("1g.18gb", 9, 16, 17856, instance_uuid(1, 3)),
        None,
        Instance("1g.18gb", 10, 16, 17856, instance_uuid(1, 5)),
        None,
    ),
    mig_on=True,
)
# Two compute instances that share the memory of one GPU instance.
A100_HALVES = Board(
    "NVIDIA A100-SXM4-80GB",
    81920,
    (8, 0),
    (
        Instance("1c.3g.40gb", 1, 14, 40192, instance_uuid(2, 0)),
        Instance("2c.3g.40gb", 1, 28, 40192, instance_uuid(2, 1)),
        Instance("3g.40gb", 2, 42, 40192, instance_uuid(2, 2)),
        *([None] * 4),
    ),
    mig_on=True,
)
H200_MIG_OFF = Board("NVIDIA H200", 143771, (9, 0), ())
H200_MIG_EMPTY = Board("NVIDIA H200", 143771, (9, 0), (None,) * 7, mig_on=True)
V100 = Board("Tesla V100-SXM2-32GB", 32768, (7, 0))


def machine_of(monkeypatch: pytest.MonkeyPatch, *boards: Board, **changes: Any) -> Machine:
    """A machine with these boards, and two CPU cores."""
    install(monkeypatch, *boards)
    driver = {"driver_version": "580.159.03"} if boards else {}
    return Machine(list_gpus(), (0, 1), **{**driver, **changes})


def install(monkeypatch: pytest.MonkeyPatch, *boards: Board, driver: str = "580.159.03") -> None:
    """Makes pynvml answer for these boards; handles are boards and instances."""

    def missing(code: int) -> NoReturn:
        raise pynvml.NVMLError(code)

    def mig_mode(board: Board) -> list[int]:
        return (
            [board.mig_on] * 2
            if board.mig is not None
            else missing(pynvml.NVML_ERROR_NOT_SUPPORTED)
        )

    def mig_handle(board: Board, place: int) -> Instance:
        found = (board.mig or ())[place]
        return missing(pynvml.NVML_ERROR_NOT_FOUND) if found is None else found

    def name(handle: Any) -> str:
        if isinstance(handle, Board):
            return handle.name
        board = next(one for one in boards if handle in (one.mig or ()))
        return f"{board.name} MIG {handle.profile}"

    def uuid(handle: Any) -> str:
        return handle.uuid if isinstance(handle, Instance) else f"GPU-{boards.index(handle)}-uuid"

    answers = {
        "nvmlInit": lambda: None,
        "nvmlShutdown": lambda: None,
        "nvmlSystemGetDriverVersion": lambda: driver,
        "nvmlDeviceGetCount": lambda: len(boards),
        "nvmlDeviceGetHandleByIndex": lambda index: boards[index],
        "nvmlDeviceGetUUID": uuid,
        "nvmlDeviceGetName": name,
        "nvmlDeviceGetMemoryInfo": lambda one: SimpleNamespace(total=one.memory_mib * MIB),
        "nvmlDeviceGetCudaComputeCapability": lambda board: board.capability,
        "nvmlDeviceGetMigMode": mig_mode,
        "nvmlDeviceGetMaxMigDeviceCount": lambda board: len(board.mig),
        "nvmlDeviceGetMigDeviceHandleByIndex": mig_handle,
        "nvmlDeviceGetGpuInstanceId": lambda one: one.gpu_instance,
        "nvmlDeviceGetAttributes": lambda one: SimpleNamespace(multiprocessorCount=one.num_sms),
        "nvmlDeviceGetComputeMode": lambda board: board.compute_mode,
    }
    for function, answer in answers.items():
        monkeypatch.setattr(pynvml, function, answer)
