"""The only caller of NVML."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import pynvml

_MIB = 1024 * 1024
DEVICES = Path("/dev")
"""Where files of devices are."""


class MigInstance(NamedTuple):
    """A MIG device as NVML lists it: a compute instance with the memory of its GPU instance."""

    uuid: str  # `MIG-...`, what `CUDA_VISIBLE_DEVICES` takes.
    profile: str  # E.g. `3g.71gb`; `1c.3g.71gb` for a part of the SMs of a GPU instance.
    gpu_instance: int  # Number of the GPU instance; those that share one share its memory.
    num_sms: int  # Streaming multiprocessors.
    memory_mib: int  # Memory of the GPU instance, MiB.


class Gpu(NamedTuple):
    """A GPU as NVML lists it."""

    index: int  # In the list of nvidia-smi.
    uuid: str  # `GPU-...`.
    name: str  # Product name.
    memory_mib: int  # Total memory, MiB.
    compute_capability: tuple[int, int]  # (major, minor).
    mig_enabled: bool  # The GPU can only be used through its MIG instances.
    # Those that exist, in the order of NVML; an administrator makes them.
    instances: tuple[MigInstance, ...] = ()
    mig_supported: bool = False  # It could be divided into MIG instances.
    # `default`, `exclusive` (one process, or one MPS server) or `prohibited`.
    compute_mode: str = "default"


class GpuLoad(NamedTuple):
    """What a GPU does at the moment, for all its processes.

    Attributes:
      used_mib, total_mib: memory.
      busy: part of the time in which some kernel runs, 0 to 1; 1 where that is not known.
    """

    used_mib: float
    total_mib: float
    busy: float


@contextmanager
def nvml_session() -> Iterator[None]:
    """NVML while it is entered; raises NVMLError without a driver."""
    pynvml.nvmlInit()
    try:
        yield
    finally:
        pynvml.nvmlShutdown()


def list_gpus() -> tuple[Gpu, ...]:
    """All GPUs of the machine, whatever `CUDA_VISIBLE_DEVICES` says; none without a driver.

    A GPU that NVML cannot describe (fallen off the bus, not permitted) is left out.
    """
    gpus: list[Gpu] = []
    with suppress(pynvml.NVMLError), nvml_session():
        for index in range(pynvml.nvmlDeviceGetCount()):
            with suppress(pynvml.NVMLError):
                gpus.append(_describe(index))
    return tuple(gpus)


def load_of(device: str) -> GpuLoad | None:
    """Of the GPU or MIG instance with this UUID; None: NVML does not report it."""
    with suppress(pynvml.NVMLError), nvml_session():
        handle = pynvml.nvmlDeviceGetHandleByUUID(device)
        memory = pynvml.nvmlDeviceGetMemoryInfo(handle)
        busy = 1.0
        with suppress(pynvml.NVMLError):  # NVML does not report it for MIG instances.
            busy = int(pynvml.nvmlDeviceGetUtilizationRates(handle).gpu) / 100
        return GpuLoad(int(memory.used) / _MIB, int(memory.total) / _MIB, busy)
    return None


def nvml_problem() -> str | None:
    """Why NVML fails although a driver is there; None where it works or there is no driver."""
    return _problem(lambda: None)


def gpu_problem() -> str | None:
    """Why `list_gpus` is empty although a driver is there; None where there is nothing to list."""
    return _problem(lambda: [_describe(i) for i in range(pynvml.nvmlDeviceGetCount())])


def _problem(ask: Callable[[], object]) -> str | None:
    try:
        with nvml_session():
            ask()
    except pynvml.NVMLError as error:
        absent = (pynvml.NVML_ERROR_LIBRARY_NOT_FOUND, pynvml.NVML_ERROR_DRIVER_NOT_LOADED)
        if getattr(error, "value", None) not in absent:
            return str(error)
        devices = sorted(DEVICES.glob("nvidia[0-9]*"))
        return f"{error}, although there is {devices[0]}" if devices else None
    return None


def driver_version() -> str | None:
    """The NVIDIA driver's version, e.g. `580.159.03`; None without a driver."""
    with suppress(pynvml.NVMLError), nvml_session():
        return str(pynvml.nvmlSystemGetDriverVersion())
    return None


def _describe(index: int) -> Gpu:
    handle = pynvml.nvmlDeviceGetHandleByIndex(index)
    major, minor = pynvml.nvmlDeviceGetCudaComputeCapability(handle)
    mig_supported, mig_enabled = True, False
    try:
        mig_enabled = pynvml.nvmlDeviceGetMigMode(handle)[0] == pynvml.NVML_DEVICE_MIG_ENABLE
    except pynvml.NVMLError:  # GPUs without MIG answer the question with an error.
        mig_supported = False
    return Gpu(
        index=index,
        uuid=str(pynvml.nvmlDeviceGetUUID(handle)),
        name=str(pynvml.nvmlDeviceGetName(handle)),
        memory_mib=int(pynvml.nvmlDeviceGetMemoryInfo(handle).total) // _MIB,
        compute_capability=(major, minor),
        mig_enabled=mig_enabled,
        instances=_instances(handle) if mig_enabled else (),
        mig_supported=mig_supported,
        compute_mode=_compute_mode(handle),
    )


def _instances(handle: Any) -> tuple[MigInstance, ...]:
    found: list[MigInstance] = []
    most = 0
    with suppress(pynvml.NVMLError):
        most = pynvml.nvmlDeviceGetMaxMigDeviceCount(handle)
    for index in range(most):
        # Gaps are normal: instances keep their indices when others are removed.
        with suppress(pynvml.NVMLError):
            found.append(_describe_instance(handle, index))
    return tuple(found)


def _describe_instance(handle: Any, index: int) -> MigInstance:
    instance = pynvml.nvmlDeviceGetMigDeviceHandleByIndex(handle, index)
    name = str(pynvml.nvmlDeviceGetName(instance))
    return MigInstance(
        uuid=str(pynvml.nvmlDeviceGetUUID(instance)),
        # NVIDIA H200 MIG 3g.71gb
        profile=name.rpartition("MIG ")[2],
        gpu_instance=int(pynvml.nvmlDeviceGetGpuInstanceId(instance)),
        num_sms=int(pynvml.nvmlDeviceGetAttributes(instance).multiprocessorCount),
        memory_mib=int(pynvml.nvmlDeviceGetMemoryInfo(instance).total) // _MIB,
    )


def _compute_mode(handle: Any) -> str:
    try:
        mode = pynvml.nvmlDeviceGetComputeMode(handle)
    except pynvml.NVMLError:
        return "default"
    return {
        pynvml.NVML_COMPUTEMODE_PROHIBITED: "prohibited",
        pynvml.NVML_COMPUTEMODE_EXCLUSIVE_PROCESS: "exclusive",
    }.get(mode, "default")
