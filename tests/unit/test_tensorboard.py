"""What is used of tensorboardX does not import PyTorch."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

LATER = """
import gmijax.runs.tensorboard
assert "torch" not in sys.modules, "imported"
import torch
assert torch.Tensor is int
"""
BEFORE = "import torch, gmijax.runs.tensorboard; assert sys.modules['torch'] is torch"


@pytest.mark.parametrize("program", [LATER, BEFORE])
def test_torch_stays_out_and_is_imported_before_or_later(program: str, tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text("Tensor = int\n")
    env = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    words = [sys.executable, "-c", f"import sys\n{program}"]
    run = subprocess.run(words, env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
