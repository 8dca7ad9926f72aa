"""The profile store: what it keeps, and what it does with a file that is broken."""

from __future__ import annotations

import errno
import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from gmijax.autotune.grid import Measured, NotRunnable, Point
from gmijax.autotune.store import ProfileStore
from gmijax.errors import ConfigError, GmijaxError

KEY = {"device": "NVIDIA H200, 143771 MiB", "task": "ant", "versions": {"jax": "0.11.2"}}
POINT = Point(4, 2048, "jax")
MEASURED = Measured(345_000.5, 812.25, 0.095, 0.0125)


def store(folder: Path, **changes: object) -> tuple[ProfileStore, list[str]]:
    notes: list[str] = []
    return ProfileStore(folder, {**KEY, **changes}, notes.append), notes


def test_what_was_put_is_there_for_the_next_search(tmp_path: Path):
    first, _ = store(tmp_path / "new" / "folder")
    assert first.get("search", POINT) is None
    large, trainers = POINT._replace(num_envs=16384), POINT._replace(trainers=2)
    first.put("search", POINT, MEASURED, 21.0)
    first.put("search", large, NotRunnable("out of memory"), 5.0)
    first.put("search", trainers, MEASURED._replace(acting_per_s=5.0), 21.0)
    second, notes = store(tmp_path / "new" / "folder")
    assert second.get("search", POINT) == MEASURED
    assert second.get("search", large) == NotRunnable("out of memory")
    assert second.get("search", trainers) == MEASURED._replace(acting_per_s=5.0)
    for other in (POINT._replace(gmis_per_gpu=2), POINT._replace(impl="warp")):
        assert second.get("search", other) is None
    assert second.get("isolated", POINT) is None
    assert notes == []
    content = json.loads(first.path.read_text())
    assert content["key"] == KEY
    assert content["profiles"]["search 4x2048 jax"] == {**MEASURED._asdict(), "wall_s": 21.0}
    assert content["profiles"]["search 4+2x2048 jax"]["acting_per_s"] == 5.0


def test_another_device_task_or_version_has_a_file_of_its_own(tmp_path: Path):
    first, _ = store(tmp_path)
    first.put("search", POINT, MEASURED, 21.0)
    assert first.path.name.startswith("nvidia-h200-143771-mib-ant-")
    for changes in ({"device": "A100"}, {"task": "humanoid"}, {"versions": {"jax": "0.12"}}):
        other, _ = store(tmp_path, **changes)
        assert other.path != first.path
        assert other.get("search", POINT) is None


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"profiles": []}',
        '{"profiles": {"search 4x2048 jax": {"wall_s": 3}}}',
        '{"profiles": {"search 4x2048 jax": {"env_steps_per_s": "fast", "wall_s": 3}}}',
        '{"profiles": {"search 4x2048 jax": 7}}',
    ],
)
def test_a_broken_file_is_moved_aside_and_reported(content: str, tmp_path: Path):
    path = store(tmp_path)[0].path
    path.write_text(content)
    broken, notes = store(tmp_path)
    assert broken.get("search", POINT) is None
    aside = path.with_name(f"{path.name}.broken")
    assert aside.read_text() == content
    assert len(notes) == 1
    assert f"profile store {path} is broken" in notes[0]
    assert str(aside) in notes[0]
    broken.put("search", POINT, MEASURED, 1.0)
    path.write_text(content)
    store(tmp_path)  # A second one does not replace the first.
    assert aside.with_name(f"{aside.name}1").exists()


def test_a_folder_that_cannot_be_used_is_bad_input(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"search\.store=.*file/x: cannot make the folder \(Not"):
        store(tmp_path / "file" / "x")
    with pytest.raises(ConfigError, match=r"search\.store=.*file: is not a folder$"):
        store(tmp_path / "file")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_gets_full_while_a_search_runs_is_no_bad_input(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, _ = store(tmp_path)

    def write(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("gmijax.autotune.store.write_json", write)
    with pytest.raises(GmijaxError, match=os.strerror(number)) as raised:
        found.put("search", POINT, MEASURED, 1.0)
    assert not isinstance(raised.value, ConfigError)


def test_files_of_versions_without_trainers_can_be_read(tmp_path: Path):
    path = store(tmp_path)[0].path
    figures = {"env_steps_per_s": 345_000.5, "memory_mib": 812.25, "iteration_s": 0.095}
    old = {"search 4x2048 jax": {**figures, "reduce_s": 0.0125, "wall_s": 21.0}}
    path.write_text(json.dumps({"key": KEY, "profiles": old}))
    found, notes = store(tmp_path)
    assert found.get("search", POINT) == MEASURED
    assert notes == []


def test_searches_at_once_keep_what_all_of_them_found(tmp_path: Path):
    points = [POINT._replace(num_envs=size) for size in range(1, 31)]
    stores = [store(tmp_path)[0] for _ in range(3)]

    def put_all(mine: ProfileStore, some: list[Point]) -> None:
        for point in some:
            mine.put("search", point, MEASURED, 1.0)

    with ThreadPoolExecutor(3) as pool:
        done = [pool.submit(put_all, mine, points[k::3]) for k, mine in enumerate(stores)]
        assert [one.result(timeout=60) for one in done] == [None] * 3
    found, notes = store(tmp_path)
    assert [found.get("search", point) for point in points] == [MEASURED] * 30
    assert notes == []
