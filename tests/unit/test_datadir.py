"""Folders of experience: which shards count, and what may be continued."""

from __future__ import annotations

from pathlib import Path

import pytest

from gmijax.errors import ConfigError
from gmijax.runs.dataset import DataPaths, open_dataset
from gmijax.runs.folder import locked, write_json


def make_shard(paths: DataPaths, rank: int, index: int) -> None:
    shard = paths.shard(rank, index)
    shard.arrays.parent.mkdir(parents=True, exist_ok=True)
    shard.arrays.write_bytes(b"12345")
    write_json(shard.about, {"num_bytes": 5})


def test_shards_count_from_the_first_on_without_a_gap(tmp_path: Path):
    paths = DataPaths(tmp_path)
    for index in (0, 1, 3):
        make_shard(paths, 2, index)
    assert paths.num_finished(2) == 2
    assert paths.num_finished(0) == 0
    assert [shard.arrays.name for shard in paths.finished()] == ["000000.npz", "000001.npz"]


@pytest.mark.parametrize("harm", ["cut off", "no json", "half a json"])
def test_an_unfinished_shard_does_not_count(harm: str, tmp_path: Path):
    paths = DataPaths(tmp_path)
    make_shard(paths, 0, 0)
    shard = paths.shard(0, 0)
    if harm == "cut off":
        shard.arrays.write_bytes(b"123")
    elif harm == "no json":
        shard.about.unlink()
    else:
        shard.about.write_text('{"num_by')
    assert paths.num_finished(0) == 0


def test_a_copy_of_a_folder_of_shards_does_not_count(tmp_path: Path):
    (tmp_path / "gmi_000.bak").mkdir()
    assert not list(DataPaths(tmp_path).finished())


def test_only_the_same_experience_is_continued(tmp_path: Path):
    paths = DataPaths(tmp_path / "new")
    open_dataset(paths, {"seed": 1, "num_envs": 4})
    open_dataset(paths, {"seed": 1, "num_envs": 4})
    with pytest.raises(ConfigError, match="holds experience with seed=1, this job would add 2"):
        open_dataset(paths, {"seed": 2, "num_envs": 4})


@pytest.mark.parametrize("content", ["{", "[]"])
def test_a_broken_dataset_is_told(content: str, tmp_path: Path):
    paths = DataPaths(tmp_path)
    paths.dataset.write_text(content)
    with pytest.raises(ConfigError, match=r"dataset.json: broken \("):
        open_dataset(paths, {"seed": 1})


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(ConfigError, match="not empty and holds no experience"):
        open_dataset(DataPaths(tmp_path), {"seed": 1})
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_one_job_at_a_time_writes_into_a_folder(tmp_path: Path):
    paths = DataPaths(tmp_path)
    with (
        locked(paths.lock, "output.dir=x"),
        pytest.raises(ConfigError, match=r"output\.dir=x: another job writes"),
        locked(paths.lock, "output.dir=x"),
    ):
        pass
    with locked(paths.lock, "output.dir=x"):
        pass
