"""`python -m gmijax.view` as a user runs it, with a browser's part played by a websocket."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

pytest.importorskip("viser")
pytest.importorskip("mjviser")

from plain_run import add_checkpoint, make_plain_run
from viewer_client import Client
from websockets.exceptions import InvalidStatus

from gmijax.runs.folder import RunPaths

pytestmark = pytest.mark.timeout(120)


class Viewer:
    """A running `gmijax view`."""

    def __init__(self, run: RunPaths, log: IO[str], *overrides: str) -> None:
        words = (f"run.dir={run.root}", "view.port=0", "num_envs=2", *overrides)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "gmijax.view", *words],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        assert self.process.stdout is not None
        self.lines: list[str] = []
        for line in self.process.stdout:
            self.lines.append(line.strip())
            if "Ctrl-C" in line:
                break
        self.url = next(line for line in self.lines if line.startswith("http://"))


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[Viewer]:
    run = make_plain_run(tmp_path / "run", 100)
    with (tmp_path / "stderr.log").open("w+") as log:
        viewer = Viewer(run, log)
        yield viewer
        viewer.process.kill()
        viewer.process.communicate()


def test_it_serves_follows_and_ends(viewer: Viewer, tmp_path: Path) -> None:
    assert viewer.url.startswith("http://127.0.0.1:")
    assert "ssh -L" in viewer.lines[-1]
    with pytest.raises(InvalidStatus) as refused:
        Client("/".join(viewer.url.split("/")[:3]) + "/")
    assert refused.value.response.status_code == 403
    with Client(viewer.url) as client:
        client.look()
        client.wait_for("BatchedGlbMessage")
        add_checkpoint(RunPaths(tmp_path / "run"), 200)
        # The state of the page says it, once the viewer has found and read it.
        while "following, 200 steps" not in str(client.receive()):
            pass
        mapped = Path(f"/proc/{viewer.process.pid}/maps").read_text()
        assert "mujoco" in mapped
        assert "jaxlib" not in mapped
        children = Path(f"/proc/{viewer.process.pid}/task/{viewer.process.pid}/children")
        assert children.read_text() == ""
    viewer.process.send_signal(signal.SIGINT)
    rest, _ = viewer.process.communicate(timeout=30)
    assert viewer.process.returncode == 130
    assert rest == ""
    assert (tmp_path / "stderr.log").read_text() == "gmijax.view: interrupted\n"


def test_bad_input_is_one_line(tmp_path: Path) -> None:
    run = make_plain_run(tmp_path / "run", 100)
    done = subprocess.run(
        [sys.executable, "-m", "gmijax.view", f"run.dir={run.root}", "view.host=256.0.0.1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("gmijax.view: view.host=256.0.0.1")
    assert len(done.stderr.splitlines()) == 1
