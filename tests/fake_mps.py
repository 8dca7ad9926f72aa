"""A fake `nvidia-cuda-mps-control` in PATH, and the commands that it got."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from supervision import CHECKOUT, TESTS


class FakeMps:
    """Puts the program into a folder in PATH, while a test runs."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        programs = folder / "bin"
        programs.mkdir()
        self.program = programs / "nvidia-cuda-mps-control"
        self.journal = folder / "journal"
        source = (TESTS / "fake_mps_control.py").read_text()
        self.program.write_text(f"#!{sys.executable} -IS\n{source}")
        self.program.chmod(0o755)
        monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
        monkeypatch.setenv("FAKE_MPS_JOURNAL", str(self.journal))
        monkeypatch.setenv("PYTHONPATH", str(CHECKOUT))
        # What is no client by then is none.
        monkeypatch.setattr("gmijax.supervise.backends.mps._CLIENTS_APPEAR_S", 1.0)

    def commands(self, command: str) -> list[list[str]]:
        """Arguments of every `command` so far."""
        lines = self.journal.read_text().splitlines() if self.journal.exists() else []
        return [line.split()[1:] for line in lines if line.split()[0] == command]

    def pipe_directories(self) -> list[Path]:
        """Of all daemons that were started."""
        return [Path(directory) for _, directory in self.commands("start")]

    def left(self) -> list[Path]:
        """Pipe directories of daemons that are still there."""
        return [path for path in self.pipe_directories() if path.exists()]
