"""Roles of one's own on a real GPU. Run with `pytest -m gpu tests/gpu/test_roles_gpu.py`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from supervision import CHECKOUT

pytestmark = [pytest.mark.gpu, pytest.mark.timeout(300)]


@pytest.mark.parametrize("backend", ["mps", "share"])
def test_a_stencil_over_gmis_of_one_gpu_is_what_one_gmi_computes(
    backend: str, tmp_path: Path
) -> None:
    options = ("gmis=3", "size=768", "steps=80", f"backend={backend}")
    done = subprocess.run(
        [sys.executable, str(CHECKOUT / "examples" / "stencil.py"), *options],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["backend"] == backend
    # Strips of other heights may be compiled to other orders of the same operations.
    assert found["difference"] < 1e-5
