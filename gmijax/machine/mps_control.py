"""The only caller of `nvidia-cuda-mps-control`.

Reference: https://docs.nvidia.com/deploy/mps/ (control commands, environment variables).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gmijax.errors import BackendUnavailable

PIPE_VARIABLE = "CUDA_MPS_PIPE_DIRECTORY"
LOG_VARIABLE = "CUDA_MPS_LOG_DIRECTORY"
MEMORY_LIMIT_VARIABLE = "CUDA_MPS_PINNED_DEVICE_MEM_LIMIT"
"""Device memory that a client may take, whatever its framework: `0=20480M`."""

DEFAULT_PIPE_DIRECTORY = Path("/tmp/nvidia-mps")
"""Where CUDA looks for a daemon when `CUDA_MPS_PIPE_DIRECTORY` is not set."""

_PREFIX = "CUDA_MPS_"
_CONTROL = "nvidia-cuda-mps-control"
# Container runtimes mount the driver's programs here without extending PATH.
_MORE_FOLDERS = ("/usr/local/nvidia/bin", "/usr/bin")
_COMMAND_TIMEOUT_S = 5.0
_START_TIMEOUT_S = 20.0


def find_mps_control() -> Path | None:
    """The daemon's program: in PATH, else where drivers are mounted; None if there is none."""
    folders = (os.environ.get("PATH", os.defpath), *_MORE_FOLDERS)
    found = shutil.which(_CONTROL, path=os.pathsep.join(folders))
    return Path(found) if found else None


@dataclass(frozen=True)
class MpsControl:
    """Commands to the MPS daemon of one pipe directory.

    Every command raises BackendUnavailable if no daemon answers, or not in time.
    """

    program: Path  # `nvidia-cuda-mps-control`.
    pipe_directory: Path  # Where the daemon listens.

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
            message = messages.read_text(errors="replace").strip().replace("\n", "; ")
            raise BackendUnavailable(f"{self.program} -d failed with exit code {code}: {message}")

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

    def all_client_pids(self) -> dict[int, int]:
        """Client -> its server, over all servers of the daemon."""
        return {
            client: server
            for server in self.server_pids()
            for client in _numbers(self._command(f"get_client_list {server}"))
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
            message = (done.stdout + done.stderr).strip().replace("\n", "; ")
            raise BackendUnavailable(f"MPS daemon in {self.pipe_directory}, {command}: {message}")
        return done.stdout

    def _environment(self, more: Mapping[str, str]) -> dict[str, str]:
        # The user's own settings for MPS (limits of memory and SMs, other folders) are for other
        # clients: a daemon would make them the defaults of the GMIs.
        users = {key: value for key, value in os.environ.items() if not key.startswith(_PREFIX)}
        return {**users, PIPE_VARIABLE: str(self.pipe_directory), **more}


def _numbers(answer: str) -> tuple[int, ...]:
    return tuple(int(line) for line in re.findall(r"^\s*(\d+)\s*$", answer, re.MULTILINE))
