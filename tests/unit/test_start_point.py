"""Where a job begins: a new folder, one that exists, a checkpoint."""

from __future__ import annotations

import shutil
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from supervision import save, save_meta

import gmijax
from gmijax.cli.compose import compose
from gmijax.config import PpoConfig, TrainConfig
from gmijax.config.schema import flatten, to_dict
from gmijax.control import decide, serving
from gmijax.control.run_folder import begin_again
from gmijax.control.start_point import (
    find_start_point,
    forgotten,
    replay_line,
    require_replay_fits,
)
from gmijax.errors import ConfigError
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import META, RunPaths, create_run, read_json, write_json
from gmijax.runs.history import read_metrics
from gmijax.runs.saved_config import trained_config


def config_of(folder: Path, *overrides: str) -> TrainConfig:
    return compose(
        "env=ant",
        f"run.dir={folder}",
        "run.resume=auto",
        "algo.policy_hidden_layer_sizes=[8]",
        "algo.value_hidden_layer_sizes=[8,4]",
        *overrides,
    )


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    paths = RunPaths(tmp_path / "run")
    write_json(paths.config, to_dict(config_of(paths.root)))
    return paths


@pytest.mark.parametrize(
    ("key", "kept"),
    [
        ("history=3", "1"),
        ("action_repeat=2", "1"),
        ("randomize=episode", "off or on"),
    ],
)
def test_a_resumed_run_keeps_what_its_environments_remember(run: RunPaths, key: str, kept: str):
    save(run, 100)
    with pytest.raises(ConfigError, match=f"^env.{key}: a resumed run keeps its {kept}$"):
        find_start_point(config_of(run.root, f"env.{key}"))


def test_auto_starts_where_there_is_nothing(tmp_path: Path):
    for folder in (tmp_path / "none", tmp_path):
        beginning = find_start_point(config_of(folder))
        assert (beginning.checkpoint, beginning.is_complete) == (None, False)


def test_auto_goes_on_from_the_newest_checkpoint_that_is_whole(run: RunPaths):
    assert find_start_point(config_of(run.root))[:2] == (run, None)
    save(run, 100)
    (save(run, 200) / META).write_text("{")
    beginning = find_start_point(config_of(run.root))
    assert beginning[:3] == (run, run.checkpoint(100), False)
    assert "000000000200: passed over" in beginning.notes[0]
    assert find_start_point(config_of(run.root, "num_timesteps=100")).is_complete


def test_a_run_that_is_complete_says_what_differs_and_what_is_damaged(
    run: RunPaths, capsys: pytest.CaptureFixture[str]
):
    save(run, 100)
    (save(run, 200) / META).write_text("{")
    write_json(run.summary, {"status": "completed"})
    gmijax.train(config_of(run.root, "num_timesteps=100", "num_envs=8"), show=True)
    output = " ".join(capsys.readouterr().out.split())
    assert "000000000200: passed over" in output
    assert "changed since the run: num_envs is 8, was" in output
    assert output.index("num_envs is 8") < output.index("this run is complete already")


@pytest.mark.parametrize("named", ["run.name=5", "run.dir=runs/5", "run.name='5'"])
def test_a_run_whose_name_is_a_number_keeps_its_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    line = ("env=ant", named, "run.resume=auto")
    write_json(RunPaths(Path("runs/5")).config, to_dict(compose(*line, "num_envs=24")))
    assert compose(*line).num_envs == 24
    assert compose(*line, "num_envs=8").num_envs == 8


@pytest.mark.parametrize(
    ("left", "message"),
    [
        ("config.json", "the run folder exists already; run.resume=auto continues in it"),
        ("thesis.tex", "is not a run folder, and is not empty"),
    ],
)
@pytest.mark.parametrize(
    ("named", "shown"),
    [("run.name=5", "run.name=5 (runs/5)"), ("run.dir=runs/5", "run.dir=runs/5")],
)
def test_a_folder_that_is_refused_is_named_as_it_was_given(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    left: str,
    message: str,
    named: str,
    shown: str,
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "5").mkdir(parents=True)
    (tmp_path / "runs" / "5" / left).touch()
    with pytest.raises(ConfigError) as error:
        find_start_point(compose("env=ant", named))
    assert str(error.value) == f"{shown}: {message}"


@pytest.mark.parametrize("damage", ["cut", "missing"])
def test_auto_refuses_a_run_of_which_no_checkpoint_is_whole(run: RunPaths, damage: str):
    for steps in (100, 200):
        meta = save(run, steps) / META
        if damage == "missing":
            meta.unlink()
        else:
            meta.write_text("{")
    wrong = r"no checkpoint is whole: .*/000000000200: broken meta.json .* \(and 1 more\)"
    advice = f"; to train anew, choose another folder or remove {run.checkpoints}"
    with pytest.raises(ConfigError, match=f"^run.resume=auto: {run.root}: {wrong}{advice}$"):
        find_start_point(config_of(run.root))
    shutil.rmtree(run.checkpoints)
    assert find_start_point(config_of(run.root))[:2] == (run, None)


def test_auto_keeps_the_metrics_of_a_run_whose_checkpoints_are_gone(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(run.root.parent)
    lines = '{"env_steps": 64}\n{"env_steps": 1280}\n'
    run.metrics.write_text(lines)
    beginning = find_start_point(config_of(run.root))
    assert beginning[:2] == (run, None)
    assert beginning.notes == (
        "warning: no checkpoint in run, training starts at step 0; the metrics of the 1,280 steps "
        "before are kept in run/metrics-000000001280.jsonl",
    )
    begin_again(run, None)
    assert run.earlier_metrics(1280).read_text() == lines
    assert read_metrics(run.metrics) == []
    # Nothing was trained since.
    assert find_start_point(config_of(run.root)).notes == ()
    begin_again(run, None)
    assert run.earlier_metrics(1280).read_text() == lines


def test_auto_cuts_the_metrics_of_a_run_that_has_a_checkpoint(run: RunPaths):
    checkpoint = save(run, 64)
    run.metrics.write_text('{"env_steps": 64}\n{"env_steps": 128}\n')
    assert find_start_point(config_of(run.root)).notes == ()
    begin_again(run, checkpoint)
    assert read_metrics(run.metrics) == [{"env_steps": 64}]
    assert list(run.root.glob("metrics-*")) == []


def test_a_file_in_place_of_the_checkpoints_is_found_before_anything_is_trained(run: RunPaths):
    run.checkpoints.parent.mkdir(exist_ok=True)
    run.checkpoints.write_text("")
    with pytest.raises(ConfigError, match=r"^run.resume=auto: .*/checkpoints is not a folder$"):
        find_start_point(config_of(run.root))


def test_auto_refuses_the_folder_of_another_task(run: RunPaths):
    message = r"^run\.resume=auto: .*/run holds a run of ant with ppo, not humanoid with ppo$"
    config = compose("env=humanoid", f"run.dir={run.root}", "run.resume=auto")
    for _ in ("without a checkpoint", "with one"):
        with pytest.raises(ConfigError, match=message):
            find_start_point(config)
        save(run, 100)


def test_auto_refuses_other_networks_and_another_seed(run: RunPaths):
    save(run, 100)
    with pytest.raises(ConfigError, match="checkpoint of network widths 8 and 8:4, not 9 and 8:4"):
        find_start_point(config_of(run.root, "algo.policy_hidden_layer_sizes=[9]"))
    with pytest.raises(ConfigError, match="seed=7: a resumed run keeps its seed 0"):
        find_start_point(config_of(run.root, "seed=7"))


@pytest.mark.parametrize("key", ["activation=layer_norm_silu", "state_dependent_std=true"])
def test_auto_refuses_another_kind_of_network(run: RunPaths, key: str):
    save(run, 100)
    with pytest.raises(
        ConfigError, match=f"^algo.{key}.*: a resumed run keeps its ".replace("true", "True")
    ):
        find_start_point(config_of(run.root, f"algo.{key}"))


@pytest.mark.parametrize(
    "key", ["critic_hidden_layer_sizes=[9]", "num_atoms=51", "value_range=7.0", "activation=elu"]
)
def test_auto_refuses_other_critics(tmp_path: Path, key: str):
    paths, line = RunPaths(tmp_path / "run"), ("env=ant", "algo=sac", "run.resume=auto")
    line = (*line, f"run.dir={paths.root}")
    write_json(paths.config, to_dict(config := compose(*line)))
    hidden = config.algo.hidden_layer_sizes
    checkpoint = save_meta(paths, CheckpointMeta("ant", "sac", 100, 1, 8, hidden, "jax"))
    assert find_start_point(config).checkpoint == checkpoint
    name = key.partition("=")[0]
    with pytest.raises(ConfigError, match=f"^algo.{name}=.*: a resumed run keeps its "):
        find_start_point(compose(*line, f"algo.{key}"))


def test_a_saved_replay_has_to_fit_only_where_it_is_gone_on_with(tmp_path: Path):
    run = RunPaths(tmp_path / "run")
    line = ("env=ant", "algo=sac", "num_envs=1024", "physics.impl=jax", "algo.save_replay=true")
    line += ("algo.replay_steps=1024", "algo.replay_precision=float32")
    write_json(run.config, to_dict(config := compose(*line)))
    hidden = config.algo.hidden_layer_sizes
    checkpoint = save_meta(run, CheckpointMeta("ant", "sac", 4096, 2, 1024, hidden, "jax"))
    (checkpoint / "replay_0").mkdir()
    for num_gmis, key, is_refused, is_forgotten in (
        (2, "replay_steps=1024", False, False),
        (2, "replay_steps=512", True, False),
        (2, "replay_precision=float16", True, False),
        (2, "save_replay=false", False, True),
        (1, "replay_steps=512", False, True),
    ):
        plan: Any = SimpleNamespace(layout=SimpleNamespace(num_gmis=num_gmis))
        own = compose(*line, f"run.resume={checkpoint}", f"algo.{key}")
        with (
            pytest.raises(ConfigError, match=f"algo.{key}: the replay in the checkpoint")
            if (is_refused)
            else nullcontext()
        ):
            require_replay_fits(own, plan, checkpoint)
        assert (forgotten(own, plan) is not None) == is_forgotten
    [line] = replay_line(own, plan)
    assert line.startswith("replay of 524,288 transitions (MiB")


def test_a_folder_that_is_no_run_folder_is_not_called_one(tmp_path: Path):
    docs = tmp_path / "docs"
    docs.mkdir()
    with pytest.raises(ConfigError, match=r"already; run\.resume=auto continues in it$"):
        find_start_point(compose("env=ant", f"run.dir={docs}"))
    (docs / "index.md").touch()
    refusal = rf"^run\.dir={docs}: is not a run folder, and is not empty$"
    with pytest.raises(ConfigError, match=refusal):
        find_start_point(compose("env=ant", f"run.dir={docs}"))
    with pytest.raises(ConfigError, match=refusal):
        create_run(str(docs), None, "ant")


def test_auto_leaves_a_folder_with_something_else_alone(tmp_path: Path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ConfigError, match="is not a run folder, and is not empty"):
        find_start_point(config_of(tmp_path))
    with pytest.raises(ConfigError, match="is not a folder"):
        find_start_point(config_of(tmp_path / "thesis.tex"))


@pytest.mark.parametrize(
    ("name", "message"),
    [("thesis.tex", "thesis.tex: is not a folder$"), ("a" * 300, r"\(File name too long\)$")],
)
def test_a_sweep_goes_on_in_a_folder_only(tmp_path: Path, name: str, message: str):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ConfigError, match=rf"^run\.dir=.*{message}"):
        gmijax.sweep([compose("env=ant", f"run.dir={tmp_path / name}")])


def test_a_folder_that_exists_is_refused_before_anything_else(run: RunPaths):
    with pytest.raises(ConfigError, match=r"already; run\.resume=auto continues"):
        find_start_point(compose("env=ant", f"run.dir={run.root}", "num_envs=auto"))


UNTRAINED = {"status": "failed", "algo": "ppo", "env_steps": None, "checkpoint": None}


@pytest.mark.parametrize("status", ["failed", "interrupted"])
def test_a_folder_in_which_nothing_was_trained_may_be_used_again(run: RunPaths, status: str):
    write_json(run.summary, UNTRAINED | {"status": status})
    found = find_start_point(compose("env=anymal", f"run.dir={run.root}"))
    assert (found.folder, found.checkpoint) == (run, None)
    assert found.notes == (f"nothing was trained in {run.root} before",)


@pytest.mark.parametrize("is_saved", [False, True])
def test_one_in_which_a_later_command_has_trained_is_not(run: RunPaths, is_saved: bool):
    """It was killed, so the summary is still that of the one before."""
    write_json(run.summary, UNTRAINED)
    if is_saved:
        save(run, 64)
    else:
        run.metrics.write_text('{"env_steps": 64}\n')
    with pytest.raises(ConfigError, match=r"already; run\.resume=auto continues"):
        find_start_point(compose("env=ant", f"run.dir={run.root}"))


@pytest.mark.parametrize(
    "other",
    [
        {"status": "completed"},
        {"status": "running"},
        {"algo": None},  # Of another command.
    ],
)
def test_nor_is_any_other_folder(run: RunPaths, other: dict[str, Any]):
    summary = {key: value for key, value in (UNTRAINED | other).items() if value or key != "algo"}
    write_json(run.summary, summary)
    with pytest.raises(ConfigError, match=r"already; run\.resume=auto continues"):
        find_start_point(compose("env=ant", f"run.dir={run.root}"))


def test_a_checkpoint_is_not_continued_in_such_a_folder(run: RunPaths, tmp_path: Path):
    write_json(run.summary, UNTRAINED)
    other = RunPaths(tmp_path / "other")
    write_json(other.config, to_dict(config_of(other.root)))
    save(other, 64)
    with pytest.raises(ConfigError, match="the run folder exists already"):
        find_start_point(compose("env=ant", f"run.dir={run.root}", f"run.resume={other.root}"))


def test_serve_refuses_a_name_that_is_taken_before_it_searches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def search(*_: Any) -> None:
        pytest.fail("searched first")

    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    monkeypatch.setattr(decide, "with_auto_decided", search)
    overrides = ("policy=random", "num_envs=auto", "run.name=mine")
    config = compose(*overrides, command="serve")
    with pytest.raises(
        ConfigError, match=r"^run\.name=mine \(runs/mine\): the run folder exists already$"
    ):
        serving.serve(config)


def as_saved_by_another_version(run: RunPaths, key: str, value: object) -> None:
    saved = read_json(run.config)
    *groups, last = key.split(".")
    place = saved
    for group in groups:
        place = place[group]
    place[last] = value
    write_json(run.config, saved)


@pytest.mark.parametrize(
    ("key", "value"),
    [("algo.gae_lambda", 0.5), ("env.rewards.energy", -0.5), ("eval.episodes", 7), ("seed", 3)],
)
def test_auto_keeps_what_the_run_has_where_the_command_says_nothing(
    run: RunPaths, key: str, value: object
):
    as_saved_by_another_version(run, key, value)
    save(run, 100)
    config = config_of(run.root)
    assert flatten(to_dict(config))[key] == value
    assert find_start_point(config).notes == ()


def test_auto_takes_what_the_command_says_and_names_it(run: RunPaths):
    as_saved_by_another_version(run, "algo.gae_lambda", 0.5)
    save(run, 100)
    for override in ("algo.gae_lambda=0.95", "num_timesteps=100", "plan.gmis_per_gpu=2"):
        config = config_of(run.root, override)
        key, _, value = override.partition("=")
        assert str(flatten(to_dict(config))[key]) == value
        [note] = find_start_point(config).notes
        assert note.startswith(f"changed since the run: {key} is {value}, was ")
    # The notes name a chosen file of settings, too.
    tuned = config_of(run.root, "tuned=humanoid_ppo")
    notes = find_start_point(tuned).notes
    assert any("algo.gae_lambda" not in note for note in notes)
    assert notes


def test_auto_takes_the_machine_from_the_command(run: RunPaths):
    # As a restart with fewer GPUs has left it.
    as_saved_by_another_version(run, "plan.gpus", 3)
    assert config_of(run.root).plan.gpus == 1


def test_a_key_that_the_version_of_the_run_did_not_have_is_no_change(run: RunPaths):
    saved = read_json(run.config)
    del saved["algo"]["activation"], saved["algo"]["policy_obs_key"]
    write_json(run.config, saved)
    save(run, 100)
    assert find_start_point(config_of(run.root)).notes == ()
    [note] = find_start_point(config_of(run.root, "algo.policy_obs_key=state")).notes
    assert note == "changed since the run: algo.policy_obs_key is 'state', was 'auto'"


@pytest.mark.parametrize("key", ["algo.future_key", "new_group", "env.future"])
def test_auto_refuses_keys_that_it_does_not_know(run: RunPaths, key: str):
    config = config_of(run.root)
    as_saved_by_another_version(run, key, 3)
    message = rf"^run\.resume=auto: .*its config\.json has keys that .* not know: {key};"
    with pytest.raises(ConfigError, match=message):
        config_of(run.root)
    # Also where the configuration comes from elsewhere, as that of a job of a sweep does.
    with pytest.raises(ConfigError, match=message):
        find_start_point(config)


def test_auto_fills_in_what_an_older_version_did_not_save(run: RunPaths):
    saved = read_json(run.config)
    del saved["algo"]["clipping_epsilon"], saved["eval"]
    write_json(run.config, saved)
    config, wanted = config_of(run.root), compose("env=ant")
    assert isinstance(config.algo, PpoConfig)
    assert isinstance(wanted.algo, PpoConfig)
    assert config.algo.clipping_epsilon == wanted.algo.clipping_epsilon
    assert config.eval == wanted.eval


@pytest.mark.parametrize("override", ["num_envs=8", "algo.clip_value_loss=true"])
def test_a_key_that_a_run_lacks_is_named_with_its_file(
    run: RunPaths, override: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(run.root.parent)
    saved = read_json(run.config)
    del saved["algo"]["clip_value_loss"]
    write_json(run.config, saved)
    save(run, 100)
    message = (
        "^run/config.json: missing key algo.clip_value_loss, as in a run of another version; add "
        "it to that file with the value that the run was trained with "
    )
    again = config_of(run.root, override), compose(f"run.resume={run.root}", override)
    tries = [partial(find_start_point, config) for config in again]
    for use in (*tries, partial(trained_config, run.checkpoint(100))):
        with pytest.raises(ConfigError, match=message):
            use()


def test_a_wrong_value_that_the_command_line_overrides_is_blamed_on_the_file(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(run.root.parent)
    as_saved_by_another_version(run, "algo.learning_rate", -1.0)
    config = config_of(run.root, "algo.learning_rate=1e-4")
    with pytest.raises(ConfigError, match=r"^run/config\.json: algo\.learning_rate=-1\.0: must"):
        find_start_point(config)


def test_auto_names_a_broken_configuration(run: RunPaths):
    run.config.write_text("{")
    with pytest.raises(ConfigError, match=rf"^{run.config}: broken \(not JSON: "):
        config_of(run.root)
