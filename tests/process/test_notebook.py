"""`examples/quickstart.ipynb` runs from its first cell to its last."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from training_jobs import POINT, POINT_TASK, child_environment

NOTEBOOK = Path(__file__).parents[2] / "examples" / "quickstart.ipynb"

# What Jupyter would show, as lines.
DISPLAY = """
import sys, types
shown = types.ModuleType("IPython.display")
shown.Image = lambda filename: ("image", filename)
shown.Video = lambda path, embed: ("video", path)
shown.display = lambda what: print("shown", *what)
python = types.ModuleType("IPython")
python.version_info = (9, 0)  # matplotlib asks.
sys.modules["IPython"], sys.modules["IPython.display"] = python, shown
"""

pytestmark = pytest.mark.timeout(300)


def test_the_quickstart_trains_draws_and_plays(tmp_path: Path):
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    written = 'settings = ["env=ball_balance", "num_timesteps=1000000"]'
    assert written in code
    tiny = [*POINT, "num_timesteps=1920", "run.name=quick"]
    code = code.replace(written, f"settings = {tiny}")
    (tmp_path / "point.py").write_text(POINT_TASK)
    done = subprocess.run(
        [sys.executable, "-c", DISPLAY + code],
        cwd=tmp_path,
        env=child_environment(),
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    curve = tmp_path / "runs" / "quick" / "returns.png"
    assert f"shown image {curve}" in done.stdout
    assert curve.is_file()
    assert "return of the last episodes: " in done.stdout
    # The toy has no model to film.
    assert "returns: " in done.stdout
    assert list((tmp_path / "runs" / "quick" / "play").glob("*/returns.json"))
