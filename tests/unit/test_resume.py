"""Which checkpoint is meant, and what of its run is used."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from supervision import save

from gmijax.cli.compose import compose
from gmijax.config import PpoConfig
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError, NoCheckpointYet
from gmijax.runs.checkpoints import CheckpointMeta, file_check, newest_checkpoint
from gmijax.runs.folder import META, RunPaths, read_json, write_json
from gmijax.runs.held import locked
from gmijax.runs.resume import (
    any_checkpoint,
    choose_checkpoint,
    find_checkpoint,
    last_run,
    unsaved_runs,
)
from gmijax.runs.saved_config import left_out, trained_config


def make_run(root: Path, *env_steps: int) -> RunPaths:
    """A run of `ant` with other settings than the defaults, and checkpoints that hold nothing."""
    paths = RunPaths(root)
    paths.root.mkdir(parents=True)
    write_json(paths.config, to_dict(compose("env=ant", "num_envs=8", "seed=5", "run.name=x")))
    for steps in env_steps:
        save(paths, steps)
    return paths


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    return make_run(tmp_path / "runs" / "x", 100, 2000)


@pytest.mark.parametrize(
    ("every", "when"),
    [(50, "after 50 iterations (run.checkpoint_every)"), (0, "when it ends")],
)
def test_a_run_that_trains_has_its_first_checkpoint_still_to_come(
    every: int, when: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    run = make_run(Path("runs") / "new")
    config = read_json(run.config)
    write_json(run.config, {**config, "run": {**config["run"], "checkpoint_every": every}})
    later = f"still training, no checkpoint yet; the first is saved {when}"
    with locked(run.lock, "new"):
        for named, beginning in (
            ("last", "run.dir=last: runs/new: "),
            ("runs/new", "=runs/new: "),
        ):
            with pytest.raises(NoCheckpointYet, match=re.escape(f"{beginning}{later}")):
                find_checkpoint(named, "run.dir")
        make_run(Path("runs") / "old", 100)
        assert last_run("run.dir").name == "old"
        assert unsaved_runs() == [Path("runs") / "new"]
    # It has ended without one.
    assert unsaved_runs() == []
    with pytest.raises(ConfigError, match="no checkpoint in this folder"):
        find_checkpoint("runs/new", "run.dir")


def test_last_is_the_run_with_the_newest_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    runs = Path("runs")
    make_run(runs / "none")
    with pytest.raises(
        ConfigError, match=r"^run\.dir=last: no run with a checkpoint in runs/; train one: "
    ):
        last_run("run.dir")
    old, new = make_run(runs / "b", 900), make_run(runs / "a", 100)
    (runs / "file").touch()
    os.utime(old.checkpoint(900) / META, (1e9, 1e9))
    os.utime(new.checkpoint(100) / META, (2e9, 2e9))
    # What is put into an old run later does not make it the last one.
    (old.root / "play").mkdir()
    (old.checkpoint(900) / "note").touch()
    (old.checkpoints / "000000001000").mkdir()
    assert last_run("run.dir") == new.root


def test_what_last_passes_over_is_named_if_it_is_newer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    runs = Path("runs")

    def begun(name: str, when_s: float, config: dict[str, Any] | None = None) -> RunPaths:
        run = make_run(runs / name)
        write_json(run.config, read_json(run.config) if config is None else config)
        write_json(run.plan, {})
        os.utime(run.config, (when_s, when_s))
        return run

    def passed_over() -> tuple[str, ...]:
        return choose_checkpoint("last", "run.resume")[1]

    chosen = make_run(runs / "chosen", 100)
    os.utime(chosen.checkpoint(100) / META, (2e9, 2e9))
    begun("older", 1e9)
    begun("served", 3e9, {"policy": "random"})
    (runs / "note").mkdir()
    assert passed_over() == ()
    begun("stopped", 3e9)
    job = make_run(runs / "swept" / "000", 50)
    os.utime(job.checkpoint(50) / META, (1e9, 1e9))
    none = "runs/stopped (no checkpoint)"
    assert passed_over() == (f"last is runs/chosen; newer, but passed over: {none}",)
    os.utime(job.checkpoint(50) / META, (3e9, 3e9))
    swept = "runs/swept (a sweep; its newest run: runs/swept/000)"
    assert passed_over() == (f"last is runs/chosen; newer, but passed over: {none}, {swept}",)
    # A run that is named is taken without a note.
    assert choose_checkpoint("runs/chosen", "run.resume")[1] == ()


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "null", "{}", '{"env": "ant"}', "\udcff"),
        '{"env": 1.5, "algo": "ppo", "env_steps": 1, "num_gmis": 1, "num_envs": 1, "hidden": [], '
        '"impl": "jax"}',
        '{"env": "a", "algo": "ppo", "env_steps": 1, "num_gmis": 1, "num_envs": 1, "hidden": 7, '
        '"impl": "jax"}',
    ],
)
def test_a_checkpoint_with_broken_meta_data_is_passed_over(run: RunPaths, text: str):
    (run.checkpoint(2000) / META).write_text(text, errors="surrogateescape")
    assert find_checkpoint(str(run.root), "run.resume") == run.checkpoint(100)
    [message] = newest_checkpoint(run.root).passed_over
    assert re.search(r"/000000002000: passed over, broken meta\.json \(.+\)$", message)
    with pytest.raises(ConfigError, match=r"^run\.resume=.*: broken meta\.json \(.+\)$"):
        find_checkpoint(str(run.checkpoint(2000)), "run.resume")
    with pytest.raises(ConfigError, match=r"000000002000: broken meta\.json \(.+\)$"):
        CheckpointMeta.read(run.checkpoint(2000))


@pytest.mark.parametrize("damage", ["truncated", "changed", "missing"])
def test_a_checkpoint_whose_files_are_not_as_written_is_passed_over(run: RunPaths, damage: str):
    weights = run.checkpoint(2000) / "learner" / "weights"
    weights.parent.mkdir()
    weights.write_bytes(b"0123456789")
    meta = CheckpointMeta.read(run.checkpoint(2000))
    meta = dataclasses.replace(meta, files={"learner/weights": file_check(weights)})
    write_json(run.checkpoint(2000) / META, meta.to_dict())
    assert newest_checkpoint(run.root) == (run.checkpoint(2000), ())
    if damage == "missing":
        weights.unlink()
    else:
        weights.write_bytes(b"01234" if damage == "truncated" else b"0123456780")
    found = newest_checkpoint(run.root)
    assert found.checkpoint == run.checkpoint(100)
    assert "learner/weights" in found.passed_over[0]
    shutil.rmtree(run.checkpoint(100))
    with pytest.raises(
        ConfigError, match=r"no checkpoint is whole: .*/000000002000: learner/weights"
    ):
        find_checkpoint(str(run.root), "run.resume")


def test_a_resumed_run_keeps_its_settings_but_those_given_again(run: RunPaths):
    config = compose(f"run.resume={run.root}", "num_envs=16", "plan=default", "run.grace_s=3")
    assert (config.env.name, config.seed, config.num_envs, config.run.grace_s) == ("ant", 5, 16, 3)
    assert config.run.resume == str(run.root)
    assert config.run.name is None


def test_what_an_older_version_did_not_save_is_filled_in_for_the_runs_own_task(run: RunPaths):
    saved = read_json(run.config)
    del saved["reduce"], saved["algo"]["reward_scaling"], saved["algo"]["bound_cost"]
    write_json(run.config, saved)
    config = compose(f"run.resume={run.root}")
    scales = [
        one.algo.reward_scaling
        for one in (config, compose("env=ant"), compose("env=ball_balance"))
        if isinstance(one.algo, PpoConfig)
    ]
    assert scales[0] == scales[1] != scales[2]
    assert config.reduce == compose().reduce
    assert config.num_envs == 8


def test_a_folder_of_runs_names_those_that_have_checkpoints(tmp_path: Path):
    for number in range(8):
        make_run(tmp_path / f"{number:03d}", *([100] if number else []))
    with pytest.raises(ConfigError) as error:
        find_checkpoint(str(tmp_path), "run.dir")
    assert str(error.value) == (
        f"run.dir={tmp_path}: no checkpoint in this folder; runs in it that have some: "
        "001, 002, 003, 004, 005 and 2 more"
    )


def test_keys_that_are_no_more_stop_a_training_and_no_policy(run: RunPaths):
    saved = read_json(run.config)
    known = trained_config(run.checkpoint(100))
    saved["env"]["gone"], saved["algo"]["gone"], saved["lost"] = 1, "x", {"inner": 2}
    write_json(run.config, saved)
    with pytest.raises(ConfigError) as error:
        compose(f"run.resume={run.root}", "num_timesteps=5000")
    assert str(error.value) == (
        f"run.resume={run.root}: its config.json has keys that this version does not know: "
        "env.gone, algo.gone, lost; take them out of that file to go on without them (the policy "
        "can be played, exported and served as it is)"
    )
    assert trained_config(run.checkpoint(100)) == known
    message = "left out, because this version does not know them: env.gone, algo.gone, lost"
    assert left_out(run.checkpoint(100)) == message
    assert compose(f"run.dir={run.root}", command="serve").env == known[0]


def test_a_run_keeps_what_it_changed_about_its_task(run: RunPaths):
    saved = read_json(run.config)
    saved["env"]["rewards"]["energy"] = -0.5
    del saved["env"]["rewards"]["alive"], saved["env"]["settings"]  # Of an older version.
    write_json(run.config, saved)
    resumed = compose(f"run.resume={run.root}", "env.rewards.progress=2").env
    served = compose(f"run.dir={run.root}", "env.rewards.progress=2", command="serve").env
    for env in (resumed, served):
        asked = compose("env=ant", "env.rewards.progress=2", "env.rewards.energy=-0.5").env
        assert (env.rewards["energy"], env.settings) == (-0.5, asked.settings)
        assert env.rewards["progress"] == 2.0
    assert compose(f"run.resume={run.root}").env.rewards["alive"] == 0.5


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.rewards.balance=1", r"unknown key env\.rewards\.balance; allowed:"),
        ("+foo.bar=1", "unknown key foo"),
        ("+algo.foo=1", "unknown key algo.foo"),
        ("tuned=ant_ppo", "tuned=ant_ppo: a resumed run keeps its settings"),
        ("~num_envs", "~num_envs: a resumed run keeps its settings"),
        ("~tuned", "~tuned: a resumed run keeps its settings"),
        ("hydra.run.dir=x", r"unknown key hydra\.run\.dir"),
        ("hydra/launcher=basic", "unknown key hydra/launcher"),
        ("num_envs=8,16", "num_envs=8,16: expected one value"),
        ("env.name=ball_balance", "choose the task with env=ball_balance"),
        ("+run={a: 1}", r"unknown key run\.a"),
        ("run=5", "run=5: expected a group of keys"),
    ],
)
def test_overrides_that_a_resumed_run_cannot_take(run: RunPaths, override: str, message: str):
    with pytest.raises(ConfigError, match=message):
        compose(f"run.resume={run.root}", override)


def test_a_checkpoint_outside_of_its_run_is_bad_input(run: RunPaths, tmp_path: Path):
    copied = tmp_path / "elsewhere" / "copied"
    shutil.copytree(run.checkpoint(100), copied)
    with pytest.raises(ConfigError, match=r"no config\.json in .*only be used in its run folder$"):
        compose(f"run.resume={copied}")


def test_a_broken_configuration_is_bad_input(run: RunPaths):
    for text, message in (
        ("{", r"config\.json: broken \(not JSON"),
        ("[]", r"config\.json: broken \(not a JSON object\)"),
        (json.dumps({"env": {}, "algo": 3}), "not the configuration of a training run"),
    ):
        run.config.write_text(text)
        with pytest.raises(ConfigError, match=message):
            compose(f"run.resume={run.root}")


def test_a_leaf_that_the_run_did_not_randomize_stays_as_it_is(run: RunPaths):
    saved = read_json(run.config)
    del saved["env"]["randomization"]["dof_damping"]
    write_json(run.config, saved)
    config = compose(f"run.resume={run.root}", "env.randomization.body_mass.range=[0.5,1.5]")
    assert set(config.env.randomization) == set(saved["env"]["randomization"])
    assert config.env.randomization["body_mass"].range == (0.5, 1.5)


def test_a_misspelt_run_folder_is_answered_with_the_one_beside_it(tmp_path: Path):
    make_run(tmp_path / "tiny", 100)
    for name, message in (
        ("tinny", r"no such folder; did you mean .*tiny\?$"),
        ("x" * 9, "folder$"),
    ):
        with pytest.raises(ConfigError, match=message):
            find_checkpoint(str(tmp_path / name), "run.dir")


@pytest.mark.parametrize(
    ("wanted", "key", "meant"),
    [
        ("5", "run.dir", "runs/5"),
        ("5", "run.resume", "runs/5"),
        ("lsat", "run.resume", "last"),
        ("lsat", "run.dir", "last"),
        ("atuo", "run.resume", "auto"),
        ("ant-one", "run.dir", "runs/ant-1"),
        ("runs/ant-one", "run.dir", "runs/ant-1"),
        ("runs/5/checkpoints", "run.resume", "runs/5"),
        ("atuo", "run.dir", None),
        ("somewhere/lsat", "run.dir", None),
        ("runs/lsat", "run.dir", None),
    ],
)
def test_a_name_that_is_no_folder_is_answered_with_what_is_meant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wanted: str, key: str, meant: str | None
):
    monkeypatch.chdir(tmp_path)
    for name in ("5", "ant-1"):
        make_run(Path("runs") / name, 100)
    for find in (find_checkpoint, any_checkpoint):
        with pytest.raises(ConfigError, match=f"^{key}={wanted}: no ") as error:
            find(wanted, key)
        hint = "" if meant is None else f"did you mean {meant}?"
        assert str(error.value).partition("; ")[2] == hint
