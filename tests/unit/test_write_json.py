"""Files of a run folder: whole, and for whom the user lets read them."""

from __future__ import annotations

import json
import os
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest

from gmijax.runs.folder import add_event, read_json, write_json


@pytest.fixture
def umask() -> Iterator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_files_are_for_whom_the_umask_lets_read_them(
    mask: int, mode: int, tmp_path: Path, umask: None
):
    os.umask(mask)
    for _ in range(2):
        write_json(tmp_path / "new.json", {"a": 1})
        assert (tmp_path / "new.json").stat().st_mode & 0o777 == mode


def test_what_cannot_be_written_leaves_the_old_file_and_nothing_else(tmp_path: Path):
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert read_json(path) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_half_an_event_is_taken_back_where_the_disk_is_full(tmp_path: Path):
    path = tmp_path / "events.jsonl"
    add_event(path, "start")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Python ignores the signal that would come with it.
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 10, limits[1]))
    try:
        add_event(path, "fault")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    add_event(path, "end")
    events = [json.loads(line)["event"] for line in path.read_text().splitlines()]
    assert events == ["start", "end"]
