"""What is found on a machine, with NVML and the control program faked."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import NoReturn

import pynvml
import pytest
from supervision import gpu

from gmijax.errors import BackendUnavailable
from gmijax.partition import machine as machine_module
from gmijax.partition.machine import Machine, detect_machine, visible_gpus
from gmijax.partition.mps_control import MpsControl, find_mps_control
from gmijax.partition.nvidia import Gpu, driver_version, list_gpus

THREE = (gpu(0), gpu(1), gpu(2))


@pytest.mark.parametrize(
    ("selection", "indices"),
    [
        (None, [0, 1, 2]),
        ("", []),
        ("-1", []),
        ("NoDevFiles", []),
        ("2, 0", [2, 0]),
        ("GPU-11-uuid", [1]),
        ("GPU-2", [2]),
        ("GPU-", []),
        ("0,7,1", [0]),
        ("1,1", [1]),
        ("MIG-123", []),
        ("²", []),
    ],
)
def test_cuda_visible_devices_is_read_as_cuda_reads_it(selection: str | None, indices: list[int]):
    assert [gpu.index for gpu in visible_gpus(THREE, selection)] == indices


@pytest.mark.parametrize(("version", "major"), [("580.159.03", 580), (None, 0), ("", 0)])
def test_driver_branch(version: str | None, major: int):
    assert Machine((), (0,), driver_version=version).driver_major == major


def test_machine_without_a_driver(monkeypatch: pytest.MonkeyPatch):
    def fail() -> None:
        raise pynvml.NVMLError(pynvml.NVML_ERROR_LIBRARY_NOT_FOUND)

    monkeypatch.setattr(pynvml, "nvmlInit", fail)
    assert list_gpus() == ()
    assert driver_version() is None
    here = detect_machine()
    assert (here.gpus, here.mps_control, here.operator_daemon) == ((), None, None)
    assert here.cpu_cores == tuple(sorted(os.sched_getaffinity(0)))


def test_gpus_are_described(monkeypatch: pytest.MonkeyPatch):
    def no_mig(handle: object) -> tuple[int, int]:
        raise pynvml.NVMLError(pynvml.NVML_ERROR_NOT_SUPPORTED)

    faked = {
        "nvmlInit": lambda: None,
        "nvmlShutdown": lambda: None,
        "nvmlDeviceGetCount": lambda: 1,
        "nvmlDeviceGetHandleByIndex": lambda index: index,
        "nvmlDeviceGetUUID": lambda handle: "GPU-a",
        "nvmlDeviceGetName": lambda handle: "NVIDIA H200",
        "nvmlDeviceGetMemoryInfo": lambda handle: SimpleNamespace(total=143771 * 2**20),
        "nvmlDeviceGetCudaComputeCapability": lambda handle: (9, 0),
        "nvmlDeviceGetMigMode": no_mig,
        "nvmlSystemGetDriverVersion": lambda: "580.159.03",
    }
    for name, function in faked.items():
        monkeypatch.setattr(pynvml, name, function)
    assert list_gpus() == (Gpu(0, "GPU-a", "NVIDIA H200", 143771, (9, 0), mig_enabled=False),)
    assert driver_version() == "580.159.03"
    monkeypatch.setattr(pynvml, "nvmlDeviceGetMigMode", lambda handle: (1, 1))
    assert list_gpus()[0].mig_enabled


def test_gpu_that_nvml_cannot_describe_is_left_out(monkeypatch: pytest.MonkeyPatch):
    def lost(*_: object) -> NoReturn:
        raise pynvml.NVMLError(pynvml.NVML_ERROR_GPU_IS_LOST)

    def describe(index: int) -> Gpu:
        return gpu(index) if index else lost()

    monkeypatch.setattr(pynvml, "nvmlInit", lambda: None)
    monkeypatch.setattr(pynvml, "nvmlShutdown", lambda: None)
    monkeypatch.setattr(pynvml, "nvmlDeviceGetCount", lambda: 2)
    monkeypatch.setattr(pynvml, "nvmlSystemGetDriverVersion", lost)
    monkeypatch.setattr("gmijax.partition.nvidia._describe", describe)
    assert list_gpus() == (gpu(1),)
    assert driver_version() is None
    monkeypatch.setattr(pynvml, "nvmlDeviceGetCount", lost)
    assert list_gpus() == ()


def script(folder: Path, text: str) -> Path:
    folder.mkdir(exist_ok=True)
    program = folder / "nvidia-cuda-mps-control"
    program.write_text(f"#!/bin/sh\n{text}\n")
    program.chmod(0o755)
    return program


def test_control_program_is_found_in_path_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    program = script(tmp_path / "bin", "true")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    assert find_mps_control() == program


def test_answers_of_the_daemon_are_read(tmp_path: Path):
    program = script(tmp_path, 'read line; [ "$line" = get_server_list ] && echo 12 && echo " 34"')
    control = MpsControl(program, tmp_path)
    assert control.server_pids() == (12, 34)
    assert control.daemon_pid() is None


def test_daemon_gets_none_of_the_users_settings_for_mps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ("ACTIVE_THREAD_PERCENTAGE", "PINNED_DEVICE_MEM_LIMIT", "LOG_DIRECTORY"):
        monkeypatch.setenv(f"CUDA_MPS_{name}", "the user's")
    control = MpsControl(script(tmp_path, "env | grep ^CUDA_ | sort; exit 1"), tmp_path / "pipe")
    logs = tmp_path / "logs"
    with pytest.raises(BackendUnavailable) as error:
        control.start("GPU-a", logs)
    assert str(error.value).endswith(
        f"exit code 1: CUDA_MPS_LOG_DIRECTORY={logs}; "
        f"CUDA_MPS_PIPE_DIRECTORY={tmp_path / 'pipe'}; CUDA_VISIBLE_DEVICES=GPU-a"
    )


def test_daemon_that_is_not_there_is_told_in_one_line(tmp_path: Path):
    control = MpsControl(script(tmp_path, "echo Cannot find MPS; exit 1"), tmp_path)
    assert not control.is_answering()
    with pytest.raises(BackendUnavailable, match=r"terminate_client 1 2: Cannot find MPS$"):
        control.terminate_client(1, 2)


def test_missing_control_program_is_told(tmp_path: Path):
    control = MpsControl(tmp_path / "none", tmp_path)
    assert not control.is_answering()
    with pytest.raises(BackendUnavailable, match=r"cannot start .*none -d"):
        control.start("GPU-a", tmp_path / "logs")


def test_operator_daemon_counts_only_if_it_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(machine_module, "list_gpus", lambda: THREE)
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", str(tmp_path))
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    script(tmp_path, "exit 1")
    assert detect_machine().operator_daemon is None
    script(tmp_path, "exit 0")
    assert detect_machine().operator_daemon == tmp_path
