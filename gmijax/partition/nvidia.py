"""The only caller of NVML and of `nvidia-cuda-mps-control`.

MPS reference: https://docs.nvidia.com/deploy/mps/ (control commands, environment variables).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pynvml

from gmijax.errors import BackendUnavailable

PIPE_VARIABLE = "CUDA_MPS_PIPE_DIRECTORY"
LOG_VARIABLE = "CUDA_MPS_LOG_DIRECTORY"
DEFAULT_PIPE_DIRECTORY = Path("/tmp/nvidia-mps")
"""Where CUDA looks for a daemon when `CUDA_MPS_PIPE_DIRECTORY` is not set."""

_PREFIX = "CUDA_MPS_"
_CONTROL = "nvidia-cuda-mps-control"
# Container runtimes mount the driver's programs here without extending PATH.
_MORE_FOLDERS = ("/usr/local/nvidia/bin", "/usr/bin")
_COMMAND_TIMEOUT_S = 5.0
_START_TIMEOUT_S = 20.0
_MIB = 1024 * 1024


class MigInstance(NamedTuple):
    """A MIG device as NVML lists it: a compute instance with the memory of its GPU instance.

    Attributes:
      uuid: `MIG-...`, what `CUDA_VISIBLE_DEVICES` takes.
      profile: e.g. `3g.71gb`; `1c.3g.71gb` for a part of the SMs of a GPU instance.
      gpu_instance: number of the GPU instance; those that share one share its memory.
      num_sms: streaming multiprocessors.
      memory_mib: memory of the GPU instance, MiB.
    """

    uuid: str
    profile: str
    gpu_instance: int
    num_sms: int
    memory_mib: int


class Gpu(NamedTuple):
    """A GPU as NVML lists it.

    Attributes:
      index: place in the list of nvidia-smi.
      uuid: `GPU-...`.
      name: product name.
      memory_mib: total memory, MiB.
      compute_capability: (major, minor).
      mig_enabled: the GPU can only be used through its MIG instances.
      instances: those that exist, in the order of NVML; an administrator makes them.
      mig_supported: it could be divided into MIG instances.
      compute_mode: `default`, `exclusive` (one process, or one MPS server) or `prohibited`.
    """

    index: int
    uuid: str
    name: str
    memory_mib: int
    compute_capability: tuple[int, int]
    mig_enabled: bool
    instances: tuple[MigInstance, ...] = ()
    mig_supported: bool = False
    compute_mode: str = "default"


def list_gpus() -> tuple[Gpu, ...]:
    """All GPUs of the machine, whatever `CUDA_VISIBLE_DEVICES` says; none without a driver.

    A GPU that NVML cannot describe (fallen off the bus, not permitted) is left out.
    """
    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError:
        return ()
    gpus: list[Gpu] = []
    try:
        for index in range(pynvml.nvmlDeviceGetCount()):
            with suppress(pynvml.NVMLError):
                gpus.append(_describe(index))
    except pynvml.NVMLError:
        return ()
    finally:
        pynvml.nvmlShutdown()
    return tuple(gpus)


def nvml_problem() -> str | None:
    """Why NVML fails although a driver is there; None where it works or there is no driver."""
    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError as error:
        absent = (pynvml.NVML_ERROR_LIBRARY_NOT_FOUND, pynvml.NVML_ERROR_DRIVER_NOT_LOADED)
        return None if getattr(error, "value", None) in absent else str(error)
    pynvml.nvmlShutdown()
    return None


def driver_version() -> str | None:
    """The NVIDIA driver's version, e.g. `580.159.03`; None without a driver."""
    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError:
        return None
    try:
        return str(pynvml.nvmlSystemGetDriverVersion())
    except pynvml.NVMLError:
        return None
    finally:
        pynvml.nvmlShutdown()


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
    places = 0
    with suppress(pynvml.NVMLError):
        places = pynvml.nvmlDeviceGetMaxMigDeviceCount(handle)
    for place in range(places):
        # Holes are normal: instances keep their places when others go.
        with suppress(pynvml.NVMLError):
            found.append(_describe_instance(handle, place))
    return tuple(found)


def _describe_instance(handle: Any, place: int) -> MigInstance:
    instance = pynvml.nvmlDeviceGetMigDeviceHandleByIndex(handle, place)
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


def find_mps_control() -> Path | None:
    """The daemon's program: in PATH, else where drivers are mounted; None if there is none."""
    folders = (os.environ.get("PATH", os.defpath), *_MORE_FOLDERS)
    found = shutil.which(_CONTROL, path=os.pathsep.join(folders))
    return Path(found) if found else None


@dataclass(frozen=True)
class MpsControl:
    """Commands to the MPS daemon of one pipe directory.

    Every command raises BackendUnavailable if no daemon answers, or not in time.

    Attributes:
      program: `nvidia-cuda-mps-control`.
      pipe_directory: where the daemon listens.
    """

    program: Path
    pipe_directory: Path

    def start(self, device: str, log_directory: Path) -> None:
        """Starts a daemon for one GPU or MIG instance, by UUID; it outlives this process.

        Raises:
          BackendUnavailable: the program cannot be run or reports an error.
        """
        log_directory.mkdir(parents=True, exist_ok=True)
        messages = log_directory / "start.log"
        environment = {
            "CUDA_VISIBLE_DEVICES": device,
            LOG_VARIABLE: str(log_directory),
        }
        try:
            # The daemon keeps its streams open: with a pipe we would wait for its end.
            with messages.open("wb") as output:
                code = subprocess.run(
                    [self.program, "-d"],
                    env=self._environment(environment),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    timeout=_START_TIMEOUT_S,
                    start_new_session=True,
                    check=False,
                ).returncode
        except (OSError, subprocess.TimeoutExpired) as error:
            raise BackendUnavailable(f"cannot start {self.program} -d: {error}") from error
        if code:
            said = messages.read_text(errors="replace").strip().replace("\n", "; ")
            raise BackendUnavailable(f"{self.program} -d failed with exit code {code}: {said}")

    def is_answering(self) -> bool:
        """Whether a daemon listens."""
        try:
            # A question about the daemon itself: there is no server before the first client.
            self._command("get_default_active_thread_percentage")
        except BackendUnavailable:
            return False
        return True

    def daemon_pid(self) -> int | None:
        """The daemon's process, from its pid file; None where it left none."""
        try:
            return int((self.pipe_directory / f"{_CONTROL}.pid").read_text())
        except (OSError, ValueError):
            return None

    def server_pids(self) -> tuple[int, ...]:
        """Processes of the daemon's servers; none before the first client came."""
        return _numbers(self._command("get_server_list"))

    def client_pids(self, server: int) -> tuple[int, ...]:
        """Processes that are clients of a server."""
        return _numbers(self._command(f"get_client_list {server}"))

    def all_client_pids(self) -> dict[int, int]:
        """Client -> its server, over all servers of the daemon."""
        return {
            client: server for server in self.server_pids() for client in self.client_pids(server)
        }

    def terminate_client(self, server: int, client: int) -> None:
        """Takes a client off the GPU in an orderly way; killing a busy one can hurt others."""
        self._command(f"terminate_client {server} {client}")

    def quit(self, timeout_s: float = _COMMAND_TIMEOUT_S) -> None:
        """Asks the daemon to end, and its servers with it."""
        self._command("quit", timeout_s)

    def _command(self, command: str, timeout_s: float = _COMMAND_TIMEOUT_S) -> str:
        """Sends one line to the daemon.

        Raises:
          BackendUnavailable: no daemon, an error, or no answer in time.
        """
        try:
            done = subprocess.run(
                [self.program],
                env=self._environment({}),
                input=command + "\n",
                capture_output=True,
                text=True,
                timeout=timeout_s,
                start_new_session=True,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise BackendUnavailable(f"MPS daemon in {self.pipe_directory}: {error}") from error
        if done.returncode:
            said = (done.stdout + done.stderr).strip().replace("\n", "; ")
            raise BackendUnavailable(f"MPS daemon in {self.pipe_directory}, {command}: {said}")
        return done.stdout

    def _environment(self, more: Mapping[str, str]) -> dict[str, str]:
        # The user's own settings for MPS (limits of memory and SMs, other folders) are for other
        # clients: a daemon would make them the defaults of the GMIs.
        users = {key: value for key, value in os.environ.items() if not key.startswith(_PREFIX)}
        return {**users, PIPE_VARIABLE: str(self.pipe_directory), **more}


def _numbers(answer: str) -> tuple[int, ...]:
    return tuple(int(line) for line in re.findall(r"^\s*(\d+)\s*$", answer, re.MULTILINE))
