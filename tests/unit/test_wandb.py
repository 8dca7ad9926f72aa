"""Following a run for Weights & Biases, in its offline mode or with a module in its place."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from command_lines import run as run_command

from gmijax.cli.compose import compose
from gmijax.config import TrainConfig
from gmijax.control import wandb_link
from gmijax.control.wandb_link import followed
from gmijax.runs.folder import RunPaths, write_json

FAKE = """
import json, os
class Run:
    def __init__(self, id): self.id, self.summary = id, {}
    def log(self, values, step): record("log", step=step, values=values)
    def finish(self, exit_code): record("finish", exit_code=exit_code, summary=self.summary)
def record(what, **fields):
    with open(os.environ["FAKE_LOG"], "a") as file:
        file.write(json.dumps({"what": what, **fields}) + "\\n")
def Settings(**fields):
    return fields
def Video(path, caption, format):
    return {"film": os.path.basename(path), "caption": caption, "format": format}
def init(*, id, dir, **fields):
    if os.environ.get("FAKE_FAILS"):
        raise RuntimeError("no\\nnetwork")
    record("init", id=id, **fields)
    return Run(id)
"""


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file with the calls of a fake wandb, one JSON object a line."""
    (tmp_path / "wandb.py").write_text(FAKE)
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    monkeypatch.setenv("PYTHONPATH", path)
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "calls.jsonl"))
    return tmp_path / "calls.jsonl"


def calls_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def a_run(folder: Path) -> RunPaths:
    folder.mkdir()
    return RunPaths(folder)


def line(run: RunPaths, **numbers: float | None) -> None:
    with run.metrics.open("a") as file:
        file.write(json.dumps(numbers) + "\n")


def follow(
    run: RunPaths,
    config: TrainConfig,
    steps: tuple[int, ...],
    checkpoint: Path | None = None,
    summary: Mapping[str, Any] | None = None,
) -> list[str]:
    """A run with a line of metrics at each of `steps`; returns the messages to the user."""
    messages: list[str] = []
    with followed(config, run, checkpoint, messages.append):
        for env_steps in steps:
            line(run, env_steps=env_steps, **{"return": None, "loss/policy": env_steps / 2})
        if summary:
            write_json(run.summary, summary)
    return messages


def test_lines_configuration_and_summary_are_sent(tmp_path: Path, fake: Path):
    run = a_run(tmp_path / "run")
    run.videos.mkdir()
    run.video(64).touch()
    config = compose("wandb.mode=online", "wandb.project=p", "wandb.group=g", "seed=7")
    assert follow(run, config, (64, 128), summary={"status": "completed", "x": 1}) == []
    begin, *logged, end = calls_of(fake)
    assert begin["config"]["seed"] == 7
    assert (begin["project"], begin["group"], begin["name"]) == ("p", "g", "run")
    assert begin["settings"]["mode"] == "online"
    lines = [line for line in logged if "eval/video" not in line["values"]]
    assert lines == [
        {"what": "log", "step": steps, "values": {"loss/policy": steps / 2}} for steps in (64, 128)
    ]
    (film,) = [line["values"]["eval/video"] for line in logged if line not in lines]
    assert film == {"film": run.video(64).name, "caption": "64 env steps", "format": "mp4"}
    assert end == {"what": "finish", "exit_code": 0, "summary": {"status": "completed", "x": 1}}
    reached = {"env_steps": 128, "filmed_env_steps": 64}
    assert json.loads(run.wandb.read_text()) == {"id": begin["id"], **reached}
    assert not run.wandb_log.exists()


def test_a_resumed_run_goes_on_under_the_same_id(tmp_path: Path, fake: Path):
    config = compose("wandb.mode=online")
    first, second = a_run(tmp_path / "first"), a_run(tmp_path / "second")
    follow(first, config, (64, 128))
    assert follow(second, config, (64, 128, 192), first.checkpoint(128)) == []
    begins = [line for line in calls_of(fake) if line["what"] == "init"]
    assert begins[0]["id"] == begins[1]["id"]
    assert [line["step"] for line in calls_of(fake) if line["what"] == "log"] == [64, 128, 192]


def test_what_fails_is_one_line_and_no_error(
    tmp_path: Path, fake: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("FAKE_FAILS", "1")
    messages = follow(a_run(tmp_path / "run"), compose("wandb.mode=online"), (64,))
    assert messages == ["Weights & Biases: nothing more is sent: RuntimeError: no network"]
    assert not fake.exists()


def test_without_the_package_nothing_is_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(wandb_link, "versions_of", lambda names: dict.fromkeys(names))
    done = run_command("train", "wandb.mode=offline", cwd=tmp_path)
    assert (done.code, len(done.stderr.splitlines())) == (2, 1)
    assert "wandb.mode=offline: needs the package wandb (pip install" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_offline_with_the_package(tmp_path: Path):
    pytest.importorskip("wandb")
    run = a_run(tmp_path / "run")
    assert follow(run, compose("wandb.mode=offline"), (64,), summary={"status": "completed"}) == []
    (kept,) = run.root.glob("wandb/offline-run-*/*.wandb")
    content = kept.read_bytes()
    for text in (b"loss/policy", b"num_timesteps", b"completed"):
        assert text in content
    assert json.loads(run.wandb.read_text())["id"] in kept.name
