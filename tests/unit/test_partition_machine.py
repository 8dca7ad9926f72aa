"""What is found on a machine, with NVML and the control program faked."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import fake_nvml
import pynvml
import pytest
from supervision import gpu, planned

from gmijax.errors import BackendUnavailable
from gmijax.machine import nvidia
from gmijax.machine import snapshot as machine_module
from gmijax.machine.mps_control import MpsControl, find_mps_control
from gmijax.machine.nvidia import driver_version, list_gpus, nvml_problem
from gmijax.machine.snapshot import detect_machine, visible_gpus

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


@pytest.mark.parametrize(
    ("selection", "entry"),
    [
        ("7", "7 names no GPU"),
        ("all", "all names no GPU"),
        ("GPU-of-a-card-that-was-replaced", "GPU-of-a-card-that-was-replaced names no GPU"),
        # CUDA would go on with the first one alone.
        ("0, 7", "7 names no GPU"),
        ("2,none", "none names no GPU"),
        ("GPU-", "GPU- names several GPUs"),
        ("MIG-123", "MIG-123 names no GPU"),
        ("cuda:0", "cuda:0 names no GPU"),
    ],
)
def test_gpus_that_are_named_and_are_not_here_are_refused(
    selection: str, entry: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(machine_module, "list_gpus", lambda: THREE)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", selection)
    here = detect_machine()
    for backend in ("auto", "share"):
        with pytest.raises(BackendUnavailable) as error:
            planned(here, backend=backend)
        assert str(error.value) == (
            f"CUDA_VISIBLE_DEVICES={selection}: {entry}; GPUs here are 0 (GPU-00-uuid), 1 "
            "(GPU-11-uuid), 2 (GPU-22-uuid); plan.backend=cpu (or CUDA_VISIBLE_DEVICES=-1) goes "
            "on without GPUs"
        )
    assert planned(here, backend="cpu").backend == "cpu"


@pytest.mark.parametrize("selection", ["", "-1", "NoDevFiles", "1,-1,0", "0,", "1,1", " 2 , 0 "])
def test_what_cuda_takes_as_a_list_is_not_refused(selection: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(machine_module, "list_gpus", lambda: THREE)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", selection)
    assert detect_machine().selection_problem is None
    # A machine without GPUs has none that could be meant, as where NVIDIA_VISIBLE_DEVICES=none.
    monkeypatch.setattr(machine_module, "list_gpus", lambda: ())
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "7")
    assert planned(detect_machine()).backend == "cpu"


def failing(code: int) -> Callable[..., NoReturn]:
    def fail(*_: object) -> NoReturn:
        raise pynvml.NVMLError(code)

    return fail


def test_machine_without_a_driver(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pynvml, "nvmlInit", failing(pynvml.NVML_ERROR_LIBRARY_NOT_FOUND))
    assert list_gpus() == ()
    assert driver_version() is None
    here = detect_machine()
    assert (here.gpus, here.mps_control, here.operator_daemon) == ((), None, None)
    assert here.cpu_cores == tuple(sorted(os.sched_getaffinity(0)))


@pytest.mark.parametrize(
    ("board", "is_supported", "is_enabled", "profiles"),
    [
        (fake_nvml.V100, False, False, []),
        (fake_nvml.H200_MIG_OFF, True, False, []),
        (fake_nvml.H200_MIG_EMPTY, True, True, []),
        (fake_nvml.A100_SEVEN, True, True, ["1g.10gb"] * 7),
        # With holes between them.
        (fake_nvml.H200_MIXED, True, True, ["3g.71gb", "2g.35gb", "1g.18gb", "1g.18gb"]),
    ],
)
def test_gpus_and_their_instances_are_listed(
    board: fake_nvml.Board,
    is_supported: bool,
    is_enabled: bool,
    profiles: list[str],
    monkeypatch: pytest.MonkeyPatch,
):
    fake_nvml.install(monkeypatch, board)
    [found] = list_gpus()
    assert found[:5] == (0, "GPU-0-uuid", board.name, board.memory_mib, board.capability)
    assert (found.mig_supported, found.mig_enabled) == (is_supported, is_enabled)
    assert [one.profile for one in found.instances] == profiles
    assert [one[0:1] + one[2:] for one in found.instances] == [
        (one.uuid, one.gpu_instance, one.num_sms, one.memory_mib) for one in board.mig or () if one
    ]


def test_gpus_that_nvml_cannot_describe_are_left_out(
    no_devices: Path, monkeypatch: pytest.MonkeyPatch
):
    fake_nvml.install(monkeypatch, fake_nvml.V100, fake_nvml.V100)
    good, lost = pynvml.nvmlDeviceGetHandleByIndex, pynvml.NVML_ERROR_GPU_IS_LOST

    def second_only(index: int) -> object:
        return good(index) if index else failing(lost)()

    monkeypatch.setattr(pynvml, "nvmlDeviceGetHandleByIndex", second_only)
    here = detect_machine()
    assert ([found.index for found in here.gpus], here.gpu_problem) == ([1], None)
    # If none can be described the driver is broken.
    monkeypatch.setattr(pynvml, "nvmlDeviceGetHandleByIndex", failing(lost))
    here = detect_machine()
    assert (here.gpus, here.gpu_problem) == ((), str(pynvml.NVMLError(lost)))
    monkeypatch.setattr(pynvml, "nvmlDeviceGetCount", failing(lost))
    monkeypatch.setattr(pynvml, "nvmlSystemGetDriverVersion", failing(lost))
    assert (list_gpus(), driver_version()) == ((), None)
    fake_nvml.install(monkeypatch)
    assert detect_machine().gpu_problem is None


def script(folder: Path, text: str) -> Path:
    folder.mkdir(exist_ok=True)
    program = folder / "nvidia-cuda-mps-control"
    program.write_text(f"#!/bin/sh\n{text}\n")
    program.chmod(0o755)
    return program


def test_control_program_is_found_in_path_and_its_answers_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    program = script(tmp_path, 'read line; [ "$line" = get_server_list ] && echo 12 && echo " 34"')
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_mps_control() == program
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


def test_a_missing_daemon_or_program_is_reported_in_one_line(tmp_path: Path):
    control = MpsControl(script(tmp_path, "echo Cannot find MPS; exit 1"), tmp_path)
    assert not control.is_answering()
    with pytest.raises(BackendUnavailable, match=r"terminate_client 1 2: Cannot find MPS$"):
        control.terminate_client(1, 2)
    control = MpsControl(tmp_path / "none", tmp_path)
    assert not control.is_answering()
    with pytest.raises(BackendUnavailable, match=r"cannot start .*none -d"):
        control.start("GPU-a", tmp_path / "logs")


@pytest.fixture
def no_devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty /dev, and nothing hidden by the environment."""
    folder = tmp_path / "dev"
    folder.mkdir()
    monkeypatch.setattr(nvidia, "DEVICES", folder)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    return folder


def test_auto_does_not_go_on_without_gpus_where_the_driver_is_broken(
    no_devices: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(pynvml, "nvmlInit", failing(pynvml.NVML_ERROR_LIB_RM_VERSION_MISMATCH))
    here = detect_machine()
    assert nvml_problem() == here.gpu_problem
    with pytest.raises(BackendUnavailable, match=r"^plan\.backend=auto: .* does not work: RM has"):
        planned(here)
    assert planned(here, backend="cpu").backend == "cpu"
    # Who hides all GPUs need not have a driver that works.
    for selection in ("", "-1"):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", selection)
        assert planned(detect_machine()).backend == "cpu"


@pytest.mark.parametrize("code", ["LIBRARY_NOT_FOUND", "DRIVER_NOT_LOADED"])
def test_a_driver_that_is_absent_although_its_devices_are_there_is_broken(
    code: str, no_devices: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(pynvml, "nvmlInit", failing(getattr(pynvml, f"NVML_ERROR_{code}")))
    assert detect_machine().gpu_problem is None
    (no_devices / "nvidiactl").touch()
    assert (detect_machine().gpu_problem, nvml_problem()) == (None, None)
    (no_devices / "nvidia0").touch()
    problem = detect_machine().gpu_problem
    assert problem is not None
    assert problem.endswith(f"although there is {no_devices / 'nvidia0'}")


@pytest.mark.parametrize(("device", "what"), [("kfd", "a GPU for ROCm"), ("accel0", "a TPU")])
def test_a_plan_says_what_else_could_compute_here(
    device: str, what: str, no_devices: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(pynvml, "nvmlInit", failing(pynvml.NVML_ERROR_LIBRARY_NOT_FOUND))
    assert detect_machine().warnings == ()
    (no_devices / device).touch()
    warning = f"warning: {no_devices / device} looks like {what}, which gmijax does not use"
    assert planned(detect_machine()).reasons[0] == warning


@pytest.mark.parametrize(
    ("variable", "value", "is_named"),
    [
        ("JAX_ENABLE_X64", "1", True),
        ("JAX_ENABLE_X64", "True", True),
        ("JAX_ENABLE_X64", "0", False),
        ("JAX_DISABLE_JIT", "on", True),
        ("JAX_NUMPY_DTYPE_PROMOTION", "strict", True),
        ("JAX_NUMPY_DTYPE_PROMOTION", "standard", False),
        ("JAX_NUMPY_RANK_PROMOTION", "raise", True),
        ("JAX_PLATFORM_NAME", "gpu", True),
        ("JAX_TRANSFER_GUARD", "disallow", True),
        ("JAX_TRANSFER_GUARD", "log", False),
        ("JAX_DEBUG_NANS", "1", False),
    ],
)
def test_a_plan_says_with_which_settings_of_jax_gmis_do_not_compute(
    variable: str, value: str, is_named: bool, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv(variable, value)
    warning = f"warning: GMIs start without {variable}={value}, with which tasks do not work"
    assert (warning in planned(detect_machine()).reasons) == is_named


@pytest.mark.parametrize(
    ("owner", "is_used"), [(os.geteuid(), True), (0, True), (os.geteuid() + 1234, False)]
)
def test_a_daemon_of_another_user_is_not_used(
    owner: int, is_used: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    if os.geteuid() != 0:
        monkeypatch.setattr(machine_module, "foreign_owner", lambda _: None if is_used else owner)
    pipe = tmp_path / "nvidia-mps"
    pipe.mkdir()
    if os.geteuid() == 0:
        os.chown(pipe, owner, -1)
    monkeypatch.setattr(machine_module, "list_gpus", lambda: THREE)
    monkeypatch.setattr(machine_module, "DEFAULT_PIPE_DIRECTORY", pipe)
    monkeypatch.delenv("CUDA_MPS_PIPE_DIRECTORY", raising=False)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    script(tmp_path, "exit 0")
    here = detect_machine()
    assert here.operator_daemon == (pipe if is_used else None)
    warning = f"warning: {pipe} belongs to user {owner}, so the MPS daemon there is not used; "
    assert [text.startswith(warning) for text in here.warnings] == [True] * (not is_used)
    # Who names it has decided; but it must answer.
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", str(pipe))
    assert detect_machine().operator_daemon == pipe
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", "x" * 300)
    assert detect_machine().operator_daemon is None
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", str(pipe))
    script(tmp_path, "exit 1")
    assert detect_machine().operator_daemon is None


def test_a_link_of_another_user_to_a_directory_of_root_is_not_used(tmp_path: Path):
    real, link = tmp_path / "real", tmp_path / "link"
    real.mkdir()
    link.symlink_to(real)
    assert machine_module.foreign_owner(link) is None
    if os.geteuid() == 0:
        os.chown(link, 4321, -1, follow_symlinks=False)
        assert machine_module.foreign_owner(link) == 4321
