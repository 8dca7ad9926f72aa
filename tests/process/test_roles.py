"""`gmijax.launch` with real processes: messages, groups, results, and how jobs end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import gmijax
from gmijax.errors import GmiFailed, JobInterrupted
from gmijax.runs.folder import read_json
from gmijax.runs.names import nearby
from tests import role_cases
from tests.supervision import CHECKOUT
from tests.training_jobs import heartbeat_of, pids_of

pytestmark = pytest.mark.timeout(180)

SCRIPT = """
import gmijax
from dataclasses import dataclass

@dataclass
class Found:
    rank: int

class Give(gmijax.Role):
    def run(self):
        self.send(Found(self.rank), 1 - self.rank)
        return self.recv(1 - self.rank)
"""


@pytest.fixture(autouse=True)
def run_folders_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def launch(plan: object, role: object, *args: object, **options: object) -> list:
    return gmijax.launch(plan, role, *args, **{"timeout_s": 60.0, "grace_s": 2.0, **options})


def three() -> object:
    return gmijax.plan(layout=[[0, 1], [2]], backend="cpu")


def test_messages_of_all_kinds_groups_and_results(tmp_path: Path) -> None:
    run = tmp_path / "run"
    found = launch(three(), role_cases.Talk(100_000), 3, run_dir=str(run), pipe_mib=0.25)
    assert [each["where"] for each in found] == [(0, 0), (1, 0), (2, 1)]
    means = [each["mean"] for each in found]
    assert [mean["loss"] for mean in means] == [1.0] * 3
    assert isinstance(means[0]["grads"], role_cases.Pair)
    assert np.allclose(means[0]["grads"].left, 0.25)
    assert len({mean["grads"].left.tobytes() for mean in means}) == 1
    assert found[1]["total"] is None
    assert found[0]["total"].tolist() == found[2]["total"].tolist() == [0, 2, 4, 6, 8]
    assert [(each["near"].dtype, each["near"].item()) for each in found] == [
        (np.float16, 1.0), (np.float16, 1.0), (np.float16, 2.0)
    ]  # fmt: skip
    assert read_json(run / "plan.json")["layout"] == [[0, 1], [2]]


def test_the_listing_of_the_paper() -> None:
    manager = gmijax.GMIManager(num_gpus=2, backend="cpu")
    kinds = ["agent", "trainer", "agent", "trainer"]
    roles = [role_cases.Listing(gmi, kind, gmi // 2, manager) for gmi, kind in enumerate(kinds)]
    assert launch(manager, roles, 10) == [
        ("agent", 0, 1.0), ("trainer", 0, 10.0), ("agent", 1, 1.0), ("trainer", 1, 10.0)
    ]  # fmt: skip


def test_timeouts_lose_nothing_and_different_data_are_reported() -> None:
    plan = gmijax.plan(gmis_per_gpu=2, backend="cpu")
    first, second = launch(plan, role_cases.Disagree())
    two, three = (f"the mean of {count} numbers of float32" for count in (2, 3))
    assert first == f"GMI 0 asks for {two}, GMI 1 for {three}"
    assert second == f"GMI 1 asks for {three}, GMI 0 for {two}"


@pytest.mark.parametrize(
    ("ends", "message", "seen"),
    [
        ("kill", "GMI 1 failed: ended by SIGKILL", ""),
        ("raise", "GMI 1 failed: exit code 1: ZeroDivisionError: the sum is off", ""),
        ("return", "GMI 1 is gone during recv", "PeerLost"),
        ("sleep", r"for GMIs \[1\]", "CollectiveTimeout"),
    ],
)
def test_the_gmi_that_fails_is_named(ends: str, message: str, seen: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    timeout_s = 1.5 if ends == "sleep" else 30.0
    with pytest.raises(GmiFailed, match=message) as caught:
        launch(
            three(), role_cases.Wait(), str(tmp_path), ends, run_dir=str(run), timeout_s=timeout_s
        )
    notes = "\n".join(caught.value.__notes__)
    assert f"run folder: {nearby(run)}" in notes
    assert ends != "raise" or 'raise ZeroDivisionError("the sum is off")' in notes
    assert not pids_of(run)
    if seen:  # The others are ended by the controller, before they notice.
        kind, waited_s = (tmp_path / "seen").read_text().split()
        assert kind == seen
        assert float(waited_s) < 20.0  # Neither until GMI 1 wakes up, nor until a time limit.


def test_a_role_without_progress_ends_the_job() -> None:
    with pytest.raises(GmiFailed, match="GMI 0 failed: made no progress after iteration 0 within"):
        launch(gmijax.plan(backend="cpu"), role_cases.Stuck(), stall_timeout_s=0.5)


def test_a_role_that_ends_its_process_has_returned_nothing() -> None:
    with pytest.raises(GmiFailed, match=r"GMI 0 failed: .* exit code 0 inside of run") as caught:
        launch(gmijax.plan(backend="cpu"), role_cases.Exit())
    assert "sys.exit()" in "\n".join(caught.value.__notes__)


def test_an_interrupt_lets_roles_finish(tmp_path: Path) -> None:
    def interrupt() -> None:
        # A later iteration than the first: both have met in a collective, so both have begun.
        while (beat := heartbeat_of(tmp_path / "run", 1)) is None or beat.iteration < 5:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    plan = gmijax.plan(gmis_per_gpu=2, backend="cpu")
    with pytest.raises(JobInterrupted, match=r"^stopped(\n|$)"):
        launch(plan, role_cases.UntilStopped(), run_dir=str(tmp_path / "run"))


def python(*words: str | Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=150)


CALL = """
found = gmijax.launch(gmijax.plan(gmis_per_gpu=2, backend="cpu"), Give())
print(found == [Found(1), Found(0)])
"""


@pytest.mark.parametrize("is_file", [True, False], ids=["a script", "a notebook"])
def test_objects_of_classes_without_a_module_are_sent_and_returned(
    tmp_path: Path, is_file: bool
) -> None:
    (tmp_path / "give.py").write_text(SCRIPT + CALL)
    done = python("give.py") if is_file else python("-c", SCRIPT + CALL)
    assert done.stdout == "True\n", done.stderr


def test_a_role_of_a_function_with_what_it_uses() -> None:
    @dataclass
    class Found:
        value: int

    class Double(gmijax.Role):
        def __init__(self) -> None:
            self.double = lambda value: 2 * value

        def run(self, value: int) -> Found:
            others = [self.collective(Found(self.double(value))) for _ in range(2)]
            assert all(isinstance(other, Found) for other in others)
            return others[0]

    assert launch(gmijax.plan(gmis_per_gpu=2, backend="cpu"), Double(), 3.0) == [Found(6.0)] * 2


def test_a_module_that_starts_jobs_when_it_is_loaded_gets_an_error_with_the_remedy(
    tmp_path: Path,
) -> None:
    end = 'gmijax.launch(gmijax.plan(backend="cpu"), Give())\n'
    (tmp_path / "give.py").write_text(SCRIPT + end)
    done = python("-c", "import give")
    assert "ConfigError: gmijax.launch: called inside a GMI" in done.stderr
    assert 'if __name__ == "__main__":' in done.stderr


def test_the_stencil_is_the_same_over_three_gmis() -> None:
    options = ("gmis=3", "size=48", "steps=40", "backend=cpu")
    done = python(CHECKOUT / "examples" / "stencil.py", *options)
    assert json.loads(done.stdout)["difference"] == 0.0, done.stderr


def test_the_custom_role_learns(tmp_path: Path) -> None:
    task = "from tests.toy_env import point_mass_env\nmake = lambda **_: point_mass_env(100)\n"
    (tmp_path / "point.py").write_text(task)
    done = python(CHECKOUT / "examples" / "custom_role.py", "point.py:make", "2", "15")
    words = done.stdout.split()
    assert words, done.stderr
    first, last = float(words[1]), float(words[3].rstrip(","))
    assert last > first + 20.0
    assert words[-1] == "True"
