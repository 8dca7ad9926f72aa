"""What a run folder keeps of the user's git repository."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from gmijax.runs import git
from gmijax.runs.folder import RunPaths
from gmijax.runs.git import record_git


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with one commit of `task.py`."""
    for name in ("GIT_CONFIG_GLOBAL", "GIT_CONFIG_SYSTEM"):
        monkeypatch.setenv(name, "/dev/null")
    folder = tmp_path / "code"
    folder.mkdir()
    (folder / "task.py").write_text("reward = 1\n")
    who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    for line in (("init", "-q", "-b", "dev"), ("add", "."), (*who, "commit", "-q", "-m", "one")):
        subprocess.run(["git", *line], cwd=folder, check=True)
    return folder


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    (tmp_path / "run").mkdir()
    return RunPaths(tmp_path / "run")


def test_commit_and_changes_are_kept(repository: Path, run: RunPaths):
    (repository / "task.py").write_text("reward = 2\n")
    (repository / "new.py").touch()
    record_git(run, repository)
    saved = json.loads(run.git.read_text())
    head = subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=repository, text=True)
    assert saved == {
        "commit": head.strip(),
        "branch": "dev",
        "status": [" M task.py", "?? new.py"],
        "status_is_cut": False,
        "diff_is_cut": False,
    }
    assert "-reward = 1\n+reward = 2\n" in run.git_diff.read_text()


def test_a_large_diff_is_cut(repository: Path, run: RunPaths, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(git, "MAX_DIFF_BYTES", 50)
    (repository / "task.py").write_text("reward = 2\n" * 100)
    record_git(run, repository)
    assert json.loads(run.git.read_text())["diff_is_cut"] is True
    assert run.git_diff.stat().st_size == 50


def test_no_repository_and_no_git_are_no_errors(
    tmp_path: Path, repository: Path, run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path))
    record_git(run, tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    record_git(run, repository)
    assert list(run.root.iterdir()) == []
