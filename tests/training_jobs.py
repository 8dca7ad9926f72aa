"""Runs of `python -m gmijax.train` that are as small as they can be, for process tests."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gmijax.runs.resume import find_checkpoint
from gmijax.supervise.heartbeat import Heartbeat, HeartbeatBlock

TINY = (
    *("env=ball_balance", "num_envs=16", "algo.unroll_length=4", "algo.num_minibatches=2"),
    *("algo.num_updates_per_batch=2", "run.grace_s=3"),
    *("algo.policy_hidden_layer_sizes=[8]", "algo.value_hidden_layer_sizes=[8]"),
    "run.max_restarts=0",
)
STEPS = 16 * 4
"""Environment steps of one iteration of one GMI in a TINY run."""

FOREVER = "num_timesteps=1000000000"

POINT_TASK = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from toy_env import point_mass_env

def make(*, impl, max_envs):
    return point_mass_env()
"""
"""`toy_env` as the file of a task of one's own: no contacts, and it compiles in a second."""

DRAWN_TASK = (
    POINT_TASK.replace("def make(", "def toy(")
    + """
import mujoco

MODEL = '''<mujoco><worldbody>
  <light pos="0 0 3"/><geom type="plane" size="3 3 1" rgba="0 0.6 0.3 1"/>
  <camera pos="0 -3 2" xyaxes="1 0 0 0 0.5 1"/>
  <body pos="0 0 0.5"><joint type="slide" axis="1 0 0"/><geom size="0.3"/></body>
</worldbody></mujoco>'''

def make(*, impl, max_envs):
    model = mujoco.MjModel.from_xml_string(MODEL)
    return toy(impl=impl, max_envs=max_envs)._replace(mj_model=model)
"""
)
"""The same with a model, which can be filmed."""

POINT = ("env=point.py:make", *TINY[1:])
"""As TINY, with that task; `train` and `start` write its file where there is none."""


def train(
    *overrides: str,
    cwd: Path,
    timeout_s: float = 240.0,
    command: str = "train",
    safe: bool = False,
) -> subprocess.CompletedProcess[str]:
    """Runs a command to its end; if `safe` without the working directory on its path."""
    _write_task(overrides, cwd)
    return subprocess.run(
        [sys.executable, *(["-P"] if safe else []), "-m", f"gmijax.{command}", *overrides],
        cwd=cwd,
        env=child_environment(),
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def start(*overrides: str, cwd: Path, command: str = "train") -> subprocess.Popen[bytes]:
    """Starts a command; its output goes to files in `cwd`."""
    _write_task(overrides, cwd)
    with (cwd / "stdout.txt").open("wb") as out, (cwd / "stderr.txt").open("wb") as err:
        return subprocess.Popen(
            [sys.executable, "-m", f"gmijax.{command}", *overrides],
            cwd=cwd,
            env=child_environment(),
            stdout=out,
            stderr=err,
            start_new_session=True,
        )


def _write_task(overrides: Sequence[str], cwd: Path) -> None:
    if POINT[0] in overrides and not (cwd / "point.py").exists():
        (cwd / "point.py").write_text(POINT_TASK)


def child_environment() -> dict[str, str]:
    """The environment of a user who has gmijax installed or its checkout on the path."""
    import gmijax

    package = str(Path(gmijax.__file__).resolve().parent.parent)
    path = os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path}


def wait_until(
    condition: Callable[[], Any], timeout_s: float, what: str, every_s: float = 0.02
) -> Any:
    """The first true value of `condition`; an assertion error with `what` if there is none."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if value := condition():
            return value
        time.sleep(every_s)
    raise AssertionError(f"not within {timeout_s} s: {what}")


def heartbeat_of(run: Path, gmi: int) -> Heartbeat | None:
    """The last heartbeat of a GMI, from its memory; None if it does not run."""
    for pid in pids_of(run):
        try:
            variables = dict(
                item.split(b"=", 1)
                for item in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
                if b"=" in item
            )
            if variables[b"GMIJAX_GMI"] != str(gmi).encode():
                continue
            fd = int(variables[b"GMIJAX_HEARTBEAT_FD"])
            with open(f"/proc/{pid}/fd/{fd}", "r+b") as memory:
                return HeartbeatBlock(memory.fileno()).read()
        except (OSError, KeyError, ValueError):
            continue
    return None


def iteration_of(run: Path, gmi: int) -> int:
    """Iterations that a GMI says it has done."""
    beat = heartbeat_of(run, gmi)
    return 0 if beat is None else beat.iteration


def events(run: Path, event: str) -> list[dict[str, Any]]:
    """Events of this kind of a run, in order."""
    path = run / "events.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    return [found for line in lines if (found := json.loads(line))["event"] == event]


def pids_of(run: Path) -> list[int]:
    """Processes that belong to a run: their environment names its folder."""
    marker = f"GMIJAX_RUN_DIR={run}".encode()
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                variables = (entry / "environ").read_bytes().split(b"\0")
            except OSError:
                continue
            if marker in variables:
                found.append(int(entry.name))
    return found


def gmi_pid(run: Path, gmi: int) -> int | None:
    """The process of a GMI, None if it has not reported it yet."""
    beat = heartbeat_of(run, gmi)
    return None if beat is None else beat.pid


def learner_arrays(run: Path) -> list[np.ndarray]:
    """All arrays of the shared part of a run's last checkpoint."""
    import jax
    import orbax.checkpoint as ocp

    folder = find_checkpoint(str(run), "test") / "learner"
    with ocp.StandardCheckpointer() as checkpointer:
        metadata = checkpointer.metadata(folder).item_metadata
        target = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), metadata)
        return jax.tree.leaves(checkpointer.restore(folder, target))


def kill(pid: int) -> None:
    """SIGKILL, to a process that may just have ended by itself."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def kill_somebody(
    *overrides: str, cwd: Path, draw: random.Random, within_s: tuple[float, float]
) -> None:
    """Kills the controller or one of two GMIs of a job at any moment; nothing may be left."""
    cwd.mkdir()
    run = cwd / "run"
    job = start(*POINT, FOREVER, *overrides, "run.dir=run", cwd=cwd)
    time.sleep(draw.uniform(*within_s))
    kill(draw.choice([job.pid, *filter(None, (gmi_pid(run, gmi) for gmi in range(2)))]))
    code = job.wait(timeout=90)
    assert code in (1, -signal.SIGKILL), (cwd / "stderr.txt").read_text()
    wait_until(lambda: not pids_of(run), 60, f"all GMIs of {cwd.name} gone")


def shared_memory() -> set[str]:
    """Names in /dev/shm."""
    return set(os.listdir("/dev/shm"))


def require_gone(names: Callable[[], set[str]], before: set[str]) -> None:
    """Waits until `names` of a shared place are those of before: others' come and go."""
    wait_until(lambda: names() <= before, 60, f"{names.__name__} as before: {sorted(before)}")


def mps_directories() -> set[str]:
    """Pipe directories that a job might have left."""
    return {path.name for path in Path("/tmp").glob("gmijax*")}
