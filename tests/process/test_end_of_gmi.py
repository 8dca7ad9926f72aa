"""How the process of a GMI ends: as its routine did, whatever libraries do afterwards."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gmijax.supervise.child import ENV_GMI, ENV_RUN_DIR

GMI = """
import atexit, os, sys
from gmijax.supervise.child import run_gmi

class Library:
    def __del__(self):
        os.abort()  # As C++ does whose thread Python ends.

def routine(link):
    sys.modules["library"].it = Library()
    atexit.register(print, "a hook of the library", end="")
    print("a line")
    {end}

sys.modules["library"] = type(sys)("library")
{main}
"""


@pytest.mark.parametrize(
    ("end", "main", "code"),
    [
        ("return dict(steps=1)", "sys.exit(run_gmi(routine))", 0),
        ("raise ValueError('odd')", "sys.exit(run_gmi(routine))", 1),
        ("sys.exit(3)", "sys.exit(run_gmi(routine))", 3),
        # What the test itself needs: without a GMI's end the library aborts the process.
        ("", "routine(None)", -6),
    ],
)
def test_a_process_ends_as_its_routine_did(tmp_path: Path, end: str, main: str, code: int) -> None:
    environment = os.environ | {ENV_GMI: "0", ENV_RUN_DIR: str(tmp_path)}
    (tmp_path / "gmi_0").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", GMI.format(end=end, main=main)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == code, done.stderr
    if main.startswith("sys.exit"):
        assert done.stdout == "a line\na hook of the library"
        assert ("ValueError: odd" in done.stderr) == (code == 1 and "odd" in end)
    result = tmp_path / "gmi_0" / "result.json"
    assert (json.loads(result.read_text()) if result.exists() else None) == (
        {"steps": 1} if code == 0 else None
    )
