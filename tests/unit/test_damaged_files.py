"""Files of runs that were damaged, edited or are none: one line with the path, and no hang."""

from __future__ import annotations

import json
import os
import random
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from supervision import machine, planned, save, save_meta

from gmijax.cli.compose import compose
from gmijax.cli.pack import build_pack
from gmijax.config.schema import to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.control.console import open_console
from gmijax.control.job import _finished
from gmijax.control.start_point import find_start_point
from gmijax.control.summary import train_summary
from gmijax.errors import ConfigError
from gmijax.runs import folder
from gmijax.runs.checkpoints import CheckpointMeta, file_check, newest_checkpoint, what_is_broken
from gmijax.runs.folder import META, RunPaths, open_regular, read_json, write_json
from gmijax.runs.held import locked
from gmijax.runs.history import copy_history, last_env_steps, read_metrics
from gmijax.runs.saved_config import trained_config
from gmijax.sweeps.jobs import state_of
from gmijax.sweeps.progress import Progress

DEVICE = Path("/dev/zero")


def fifo(path: Path) -> None:
    os.mkfifo(path)


def raw(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (fifo, r"cannot be read \(not a regular file\)"),
        (Path.mkdir, r"cannot be read \(not a regular file\)"),
        (lambda path: path.symlink_to(DEVICE), r"cannot be read \(not a regular file\)"),
        (lambda path: path.symlink_to(path), r"cannot be read \(Too many levels"),
        (lambda path: None, r"cannot be read \(No such file"),
        (raw(b""), "broken \\(not JSON"),
        (raw(b"{"), "broken \\(not JSON"),
        (raw(b"\xff\xfe\x00"), "broken \\(not JSON"),
        (raw(b"[" * 100_000), "broken \\(nested too deeply"),
        (raw(b'{"a":' * 50_000), "broken \\(nested too deeply"),
        (raw(b'{"a": ' + b"1" * 5000 + b"}"), "broken \\(not JSON"),
        (raw(b"[]"), "broken \\(not a JSON object"),
        (raw(b"5"), "broken \\(not a JSON object"),
        (raw(b"null"), "broken \\(not a JSON object"),
    ],
)
def test_what_is_no_json_object_is_one_line(
    tmp_path: Path, make: Callable[[Path], object], message: str
):
    path = tmp_path / "file.json"
    make(path)
    with pytest.raises(ConfigError, match=f"^{path}: {message}") as error:
        read_json(path)
    assert len(str(error.value).splitlines()) == 1


def test_a_file_without_an_end_is_not_read_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(folder, "LARGEST_JSON_BYTES", 1 << 20)
    path = tmp_path / "file.json"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(ConfigError, match="larger than 1 MiB"):
        read_json(path)


def test_a_socket_is_no_regular_file():
    with pytest.raises(OSError, match="not a regular file"):
        open_regular(DEVICE)


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    paths = RunPaths(tmp_path / "run")
    write_json(paths.config, to_dict(config_of(paths)))
    save(paths, 100)
    return paths


def config_of(run: RunPaths, *overrides: str) -> Any:
    widths = ("algo.policy_hidden_layer_sizes=[8]", "algo.value_hidden_layer_sizes=[8,4]")
    return compose("env=ant", f"run.dir={run.root}", "run.resume=auto", *widths, *overrides)


META_OF_200 = CheckpointMeta("ant", "ppo", 200, 1, 8, ((8,), (8, 4)), "jax", mean_return=2.5)


def test_no_bit_of_meta_data_flips_unnoticed(run: RunPaths):
    path, rng = save_meta(run, META_OF_200) / META, random.Random(0)
    content = path.read_bytes()
    unnoticed = []
    for bit in range(8 * len(content)):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        if what_is_broken(path.parent) is None:
            unnoticed.append(json.loads(damaged) == json.loads(content))
        if rng.random() < 0.01:
            assert newest_checkpoint(run.root).checkpoint is not None
    # Only those that change nothing but blanks.
    assert all(unnoticed)


@pytest.mark.parametrize(
    "key", ["env", "impl", "mean_return", "eval_return", "time_s", "num_envs"]
)
def test_edited_meta_data_are_noticed(run: RunPaths, key: str):
    path = save_meta(run, META_OF_200) / META
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, key: 7}))
    assert "not as it was written" in str(what_is_broken(path.parent))
    del data["sha256"]
    path.write_text(json.dumps(data))
    assert what_is_broken(path.parent) is None, "those of older versions have none"


@pytest.mark.parametrize(
    "name", ["/dev/zero", "../../config.json", "link", "up/config.json", "\0", "x" * 5000, "fifo"]
)
def test_the_files_of_a_checkpoint_are_regular_and_inside_of_it(run: RunPaths, name: str):
    checkpoint = save_meta(run, META_OF_200)
    os.mkfifo(checkpoint / "fifo")
    (checkpoint / "link").symlink_to(run.config)
    (checkpoint / "up").symlink_to(run.root)
    check = file_check(run.config)
    data = {**META_OF_200.to_dict(), "files": {name: list(check)}}
    del data["sha256"]
    (checkpoint / META).write_text(json.dumps(data))
    assert what_is_broken(checkpoint) is not None
    found = newest_checkpoint(run.root)
    assert found.checkpoint == run.checkpoint(100)
    assert "passed over" in found.passed_over[0]


@pytest.mark.parametrize("content", [b"[" * 100_000, b"{", b"null", b'{"files": 5}'])
def test_bad_meta_data_hide_no_other_checkpoint(run: RunPaths, content: bytes):
    (save_meta(run, META_OF_200) / META).write_bytes(content)
    assert find_start_point(config_of(run)).checkpoint == run.checkpoint(100)


@pytest.mark.parametrize("is_held", [False, True])
def test_what_a_killed_writer_left_of_a_complete_run_is_removed(run: RunPaths, is_held: bool):
    """As a controller that is killed while a GMI writes its result leaves it."""
    left = run.gmi(1).root / ".result.json.14079-140246432381824"
    left.parent.mkdir()
    left.write_text("{")
    write_json(run.summary, {"status": "completed"})
    with locked(run.lock, "run") if is_held else nullcontext():
        _finished(config_of(run), run, open_console(show=False))
    assert left.exists() == is_held  # Somebody still writes there.


def test_a_complete_run_with_damaged_files_is_one_line(run: RunPaths):
    run.plan.write_text("{")
    with pytest.raises(ConfigError, match=f"^{run.plan}: broken"):
        _finished(config_of(run), run, open_console(show=False))
    for plan in ({}, {"layout": 5}, {"layout": [[0]], "allocations": [{}]}, {"layout": [["a"]]}):
        write_json(run.plan, plan)
        with pytest.raises(ConfigError, match=f"^{run.plan}: (not a )?plan") as error:
            _finished(config_of(run), run, open_console(show=False))
        assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("content", [b"{", b"[]", b"\xff"])
def test_a_damaged_summary_is_written_anew(run: RunPaths, content: bytes):
    write_json(run.plan, planned(machine(0), backend="cpu").to_dict())
    config = config_of(run)
    run.summary.write_bytes(content)
    assert find_start_point(config).checkpoint == run.checkpoint(100)
    assert state_of(run, config) == "waiting"
    _finished(config, run, open_console(show=False))
    assert read_json(run.summary)["status"] == "completed"


def test_a_damaged_summary_does_not_make_a_folder_a_free_one(run: RunPaths):
    run.summary.write_bytes(b"{")
    with pytest.raises(ConfigError, match=r"already; run\.resume=auto continues"):
        find_start_point(compose("env=ant", f"run.dir={run.root}"))


def test_a_job_of_a_pack_with_a_damaged_summary_says_how_to_run_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """It is not run again by itself: the program may not be one that may run twice."""
    monkeypatch.chdir(tmp_path)
    run = RunPaths(tmp_path / "job_1")
    run.root.mkdir()
    run.summary.write_text("{")
    pack = build_pack(["seed=1,2"], ["echo", "{seed}"])
    message = r"^job_1/summary\.json: broken \(.*\); remove it to run job 1 again$"
    with pytest.raises(ConfigError, match=message):
        pack.state_of(run, pack.jobs[1])


def test_a_run_without_a_seed_keeps_that_of_the_command(run: RunPaths):
    saved = read_json(run.config)
    del saved["seed"]
    write_json(run.config, saved)
    assert find_start_point(config_of(run)).checkpoint == run.checkpoint(100)


@pytest.mark.parametrize("name", [["ppo"], {}, 5, None, True])
def test_an_algorithm_that_is_no_name_is_one_line(run: RunPaths, name: object):
    saved = read_json(run.config)
    saved["algo"]["name"] = name
    write_json(run.config, saved)
    with pytest.raises(ConfigError, match=r"algo\.name="):
        find_start_point(compose("env=ant", f"run.resume={run.root}"))


def edited(run: RunPaths, key: str, value: object) -> None:
    """Writes a value into the configuration that a run has saved."""
    saved = read_json(run.config)
    group, _, name = key.rpartition(".")
    (saved[group] if group else saved)[name] = value
    write_json(run.config, saved)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("num_envs", "x", "num_envs=x: expected an integer or auto"),
        ("num_envs", -5, "num_envs=-5: must be "),
        ("run.grace_s", None, "run.grace_s=null: expected a finite number"),
        ("algo.learning_rate", "fast", "algo.learning_rate=fast: expected a finite number"),
        ("env.episode_length", 0, "env.episode_length=0: must be at least 1"),
    ],
)
@pytest.mark.parametrize("resume", ["auto", "run"])
def test_a_wrong_value_that_a_run_has_saved_is_not_blamed_on_the_command(
    resume: str,
    key: str,
    value: object,
    message: str,
    run: RunPaths,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.chdir(run.root.parent)
    folder = ("env=ant", "run.dir=run") if resume == "auto" else ()
    edited(run, key, value)
    with pytest.raises(ConfigError) as error:
        compose(*folder, f"run.resume={resume}")
    assert str(error.value).startswith(f"run/config.json: {message}")


def test_an_algorithm_without_a_name_is_blamed_on_the_file(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(run.root.parent)
    edited(run, "algo", {"name": "sca"})
    message = r"^run\.resume=run: its config\.json: algo\.name=sca: expected one of ppo, "
    with pytest.raises(ConfigError, match=message):
        compose("run.resume=run")


def test_a_wrong_value_of_the_command_is_not_blamed_on_the_file(run: RunPaths):
    message = r"^num_envs=x: expected an integer or auto$"
    with pytest.raises(ConfigError, match=message):
        compose(f"run.resume={run.root}", "num_envs=x")
    edited(run, "num_envs", "y")
    with pytest.raises(ConfigError, match=message):
        compose(f"run.resume={run.root}", "num_envs=x")
    assert compose(f"run.resume={run.root}", "num_envs=8").num_envs == 8, "it is mended by it"


def test_a_policy_needs_of_its_run_only_task_and_algorithm(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(run.root.parent)
    edited(run, "num_envs", "x")
    assert trained_config(run.checkpoint(100))[0].name == "ant"
    edited(run, "env.episode_length", "x")
    message = r"^run/config\.json: env\.episode_length=x: expected an integer or null$"
    for command in (
        lambda: trained_config(run.checkpoint(100)),
        lambda: compose("run.dir=run", command="serve"),
    ):
        with pytest.raises(ConfigError, match=message):
            command()


BAD_LINES = ("5", "[]", "{}", "null", '"x"', "{", '{"env_steps": "9"}', '{"env_steps": true}')
BAD_VALUES = ('"x"', "[1]", "{}", "true", "NaN", "Infinity", "1" + "0" * 400)


def test_what_is_no_line_of_metrics_is_passed_over(run: RunPaths, tmp_path: Path):
    good = '{"env_steps": 10, "return": 1.5, "wall_s": null}'
    bad = [*BAD_LINES, *(f'{{"env_steps": 9, "return": {value}}}' for value in BAD_VALUES)]
    run.metrics.write_text("\n".join((*bad, "[" * 100_000, good, "")))
    assert read_metrics(run.metrics) == [json.loads(good)]
    assert last_env_steps(run.metrics) == 10
    copy_history(run.metrics, tmp_path / "copy.jsonl", 100)
    assert (tmp_path / "copy.jsonl").read_text() == good + "\n"
    progress = Progress()
    progress.read(run, SweepConfig())
    assert progress.env_steps == 10
    run.metrics.unlink()
    os.mkfifo(run.metrics)
    assert read_metrics(run.metrics) == []
    assert last_env_steps(run.metrics) is None


def test_a_summary_needs_nothing_of_the_last_line_but_its_steps(run: RunPaths):
    run.metrics.write_text('{"env_steps": 10}\n')
    summary = train_summary(
        config_of(run), planned(machine(0), backend="cpu"), run, "failed", 1.0, []
    )
    assert (summary["env_steps"], summary["final_return"]) == (10, None)


@pytest.mark.parametrize("summary", [{}, {"status": "completed"}, {"status": 5, "env_steps": "x"}])
def test_a_job_of_a_sweep_whose_summary_says_nothing_has_to_run(
    run: RunPaths, summary: dict[str, Any]
):
    write_json(run.summary, summary)
    assert state_of(run, config_of(run)) == "waiting"
