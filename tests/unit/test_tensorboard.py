"""What is used of tensorboardX does not import PyTorch."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def test_torch_stays_out_of_a_training_and_can_be_imported_later(tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text("Tensor = int\n")
    program = """
import sys
import gmijax.runs.tensorboard
assert "torch" not in sys.modules, "imported"
import torch
assert torch.Tensor is int
"""
    env = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    run = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_torch_that_is_there_stays(tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text("Tensor = int\n")
    program = "import sys, torch, gmijax.runs.tensorboard; assert sys.modules['torch'] is torch"
    env = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    run = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
