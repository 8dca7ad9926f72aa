"""Stands in for `nvidia-cuda-mps-control`; keeps its state in the pipe directory.

`clients/<pid>` is a client, made by the client itself. Every command is appended to the file
named by FAKE_MPS_JOURNAL. The daemon is its own (only) server. Stdlib only: it is copied to a
folder in PATH.
"""

import os
import signal
import sys
import time
from pathlib import Path

PIPE_DIRECTORY = Path(os.environ["CUDA_MPS_PIPE_DIRECTORY"])
CLIENTS = PIPE_DIRECTORY / "clients"
PID_FILE = PIPE_DIRECTORY / "nvidia-cuda-mps-control.pid"


def is_running(pid: int) -> bool:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] not in "ZX"


def start() -> int:
    if os.environ.get("FAKE_MPS_BROKEN"):
        sys.stderr.write("An instance of this daemon is already running\n")
        return 1
    CLIENTS.mkdir()
    if daemon := os.fork():
        PID_FILE.write_text(str(daemon))
        return 0
    os.setsid()
    while True:
        time.sleep(600)


def clients() -> list[int]:
    return [int(path.name) for path in CLIENTS.iterdir() if is_running(int(path.name))]


def answer(daemon: int, command: str, *numbers: str) -> int:
    if command == "get_server_list":
        lines = [daemon] if clients() else []
    elif command == "get_client_list":
        lines = clients()
    elif command == "get_default_active_thread_percentage":
        lines = [100.0]
    else:
        lines = []
        journal(" ".join([command, *numbers]))
    if command == "terminate_client":
        (CLIENTS / numbers[1]).unlink()
    elif command == "quit":
        os.kill(daemon, signal.SIGKILL)
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    return 0


def journal(line: str) -> None:
    if path := os.environ.get("FAKE_MPS_JOURNAL"):
        with Path(path).open("a") as file:
            file.write(f"{line}\n")


def main() -> int:
    if sys.argv[1:] == ["-d"]:
        journal(f"start {os.environ['CUDA_VISIBLE_DEVICES']} {PIPE_DIRECTORY}")
        return start()
    if not PID_FILE.exists() or not is_running(int(PID_FILE.read_text())):
        sys.stdout.write("Cannot find MPS control daemon process\n")
        return 1
    return answer(int(PID_FILE.read_text()), *sys.stdin.read().split())


if __name__ == "__main__":
    sys.exit(main())
