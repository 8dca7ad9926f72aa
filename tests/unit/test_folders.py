"""Folders: which shards of experience count, what may be continued, files that are whole."""

from __future__ import annotations

import json
import os
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest
from supervision import machine, planned

from gmijax.cli.compose import compose
from gmijax.control import serving
from gmijax.errors import ConfigError, JobInterrupted
from gmijax.runs.dataset import DataPaths, open_dataset
from gmijax.runs.folder import add_event, read_json, write_json
from gmijax.runs.held import locked
from gmijax.runs.history import MetricsReader, read_metrics


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


def test_an_unfinished_shard_does_not_count(tmp_path: Path):
    paths = DataPaths(tmp_path)
    shard = paths.shard(0, 0)
    for harm in (
        lambda: shard.arrays.write_bytes(b"123"),
        shard.about.unlink,
        lambda: shard.about.write_text('{"num_by'),
    ):
        make_shard(paths, 0, 0)
        assert paths.num_finished(0) == 1
        harm()
        assert paths.num_finished(0) == 0
    (tmp_path / "gmi_000.bak").mkdir()  # Nor does a copy of a folder.
    assert not list(paths.finished())


def test_only_the_same_experience_is_continued(tmp_path: Path):
    paths = DataPaths(tmp_path / "new")
    open_dataset(paths, {"seed": 1, "num_envs": 4})
    open_dataset(paths, {"seed": 1, "num_envs": 4})
    with pytest.raises(ConfigError, match="holds experience with seed=1, this job would add 2"):
        open_dataset(paths, {"seed": 2, "num_envs": 4})
    for content in ("{", "[]"):
        paths.dataset.write_text(content)
        with pytest.raises(ConfigError, match=r"dataset.json: broken \("):
            open_dataset(paths, {"seed": 1})


ABOUT = {
    "env": {"name": "ant", "episode_length": 500, "rewards": {"near": 1.0}},
    "seed": 1,
    "num_envs": 4,
}


def test_of_other_settings_only_those_that_differ_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    paths = DataPaths(tmp_path / "data")
    open_dataset(paths, ABOUT)

    def refused(**changes: object) -> str:
        with pytest.raises(ConfigError) as error:
            open_dataset(paths, {**ABOUT, **changes})
        return str(error.value)

    of_env = {"name": "ant", "episode_length": 400, "rewards": {"near": 1.0}}
    advice = "use another folder or the same settings"
    assert refused(env=of_env) == (
        "output.dir=data: holds experience with env.episode_length=500, this job would add 400; "
        f"{advice}"
    )
    other = {"name": "go1", "episode_length": 400, "rewards": {"far": 2.0}}
    assert refused(env=other, num_envs=8) == (
        "output.dir=data: holds experience with env.name='ant', this job would add 'go1'; "
        "env.episode_length=500, this job would add 400; env.rewards.far=None, this job would add "
        f"2.0; and 2 more; {advice}"
    )


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ({"seed": 1}, "has no env"),
        ({"env": 5, "seed": 1, "num_envs": 4}, "env is no group of keys"),
        ({"env": None, "seed": 1, "num_envs": 4}, "env is no group of keys"),
        ({"env": ABOUT["env"], "seed": 1}, "has no num_envs"),
    ],
)
def test_a_data_set_without_its_keys_is_damaged(
    content: dict[str, object], why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    write_json(tmp_path / "dataset.json", content)
    with pytest.raises(ConfigError, match=rf"^dataset\.json: broken \({why}\)$"):
        open_dataset(DataPaths(tmp_path), ABOUT)


def test_experience_that_has_no_folder_is_refused_as_a_run_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    Path("train.py").touch()
    for folder, why in (
        ("train.py", "is not a folder"),
        ("train.py/x", "cannot make the folder (Not a directory)"),
        ("/proc/x", "cannot make the folder (No such file or directory)"),
    ):
        with pytest.raises(ConfigError) as error:
            open_dataset(DataPaths(Path(folder)), ABOUT)
        assert str(error.value) == f"output.dir={folder}: {why}"


def test_an_interrupted_job_names_the_folder_of_its_shards_if_there_are_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    sizes = ("num_envs=4", "unroll_length=5", "num_timesteps=40")
    config = compose("policy=random", "env=ant", *sizes, command="serve")
    plan, data = planned(machine(0), backend="cpu"), DataPaths(tmp_path / "data")
    job = serving._ServingJob(config, plan, machine(0), (0,), data, ())
    assert serving._what_is_left(job) == "no shard was finished; the same command begins again"
    make_shard(data, 0, 0)
    assert serving._what_is_left(job) == (
        "1 of 2 shards are in data; the same command makes the rest"
    )


@pytest.mark.parametrize("was_there", [True, False])
@pytest.mark.parametrize("others", [(), ("note.txt",)])
def test_of_a_job_without_a_shard_its_own_files_go_from_the_folder(
    was_there: bool, others: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    data = DataPaths(tmp_path / "data")
    if was_there:
        data.root.mkdir()
        data.root.chmod(0o2770)
    sizes = ("num_envs=4", "unroll_length=5", "num_timesteps=40")
    config = compose("policy=random", "env=ant", *sizes, command="serve")
    plan = planned(machine(0), backend="cpu")
    job = serving._ServingJob(config, plan, machine(0), (0,), data, ())

    def run(*_: object) -> None:
        data.folder(0).mkdir()
        data.shard(0, 0).arrays.write_bytes(b"half")
        for name in others:
            (data.root / name).touch()
        raise JobInterrupted("interrupted")

    monkeypatch.setattr(serving, "_prepared", lambda *_: job)
    monkeypatch.setattr(serving, "_run", run)
    with pytest.raises(JobInterrupted):
        serving.serve(config)
    assert data.root.exists() == bool(was_there or others)
    if data.root.exists():
        assert [path.name for path in data.root.iterdir()] == list(others)
    assert not was_there or data.root.stat().st_mode & 0o7777 == 0o2770


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


def test_lines_of_metrics_that_a_full_disk_has_cut_are_passed_over(tmp_path: Path):
    path = tmp_path / "metrics.jsonl"
    assert read_metrics(path) == []
    path.write_text('{"env_steps": 1}\n{"env_st{"env_steps": 3}\n{"env_steps": 4}\n{"env_')
    reader = MetricsReader(path)
    assert [line["env_steps"] for line in reader.new()] == [1, 4]
    with path.open("a") as file:
        file.write('steps": 5}\n')
    assert reader.latest() == {"env_steps": 5}
    assert [line["env_steps"] for line in read_metrics(path)] == [1, 4, 5]
