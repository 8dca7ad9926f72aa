"""Where a job begins: a new folder, one that exists, a checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest

from gmijax.cli.compose import compose
from gmijax.config import TrainConfig
from gmijax.config.schema import to_dict
from gmijax.control.start_point import find_start_point
from gmijax.errors import ConfigError
from gmijax.runs.folder import META, RunPaths, write_json
from gmijax.runs.resume import CheckpointMeta

WIDTHS = ((8,), (8, 4))


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


def save(run: RunPaths, env_steps: int) -> Path:
    meta = CheckpointMeta("ant", "ppo", env_steps, 1, 8, WIDTHS, "jax")
    write_json(run.checkpoint(env_steps) / META, meta.to_dict())
    return run.checkpoint(env_steps)


def test_auto_starts_where_there_is_nothing(tmp_path: Path):
    for folder in (tmp_path / "none", tmp_path):
        beginning = find_start_point(config_of(folder))
        assert (beginning.checkpoint, beginning.is_complete) == (None, False)


def test_auto_starts_again_where_there_is_no_checkpoint_yet(run: RunPaths):
    assert find_start_point(config_of(run.root))[:2] == (run, None)


def test_auto_goes_on_from_the_newest_checkpoint_that_is_whole(run: RunPaths):
    save(run, 100)
    (save(run, 200) / META).write_text("{")
    beginning = find_start_point(config_of(run.root))
    assert beginning[:3] == (run, run.checkpoint(100), False)
    assert "000000000200: passed over" in beginning.notes[0]


def test_auto_has_nothing_to_do_in_a_run_that_is_complete(run: RunPaths):
    save(run, 100)
    assert find_start_point(config_of(run.root, "num_timesteps=100")).is_complete


def test_auto_refuses_the_folder_of_another_task(run: RunPaths):
    message = r"^run\.resume=auto: .*/run holds a run of ant with ppo, not humanoid with ppo$"
    with pytest.raises(ConfigError, match=message):
        find_start_point(compose("env=humanoid", f"run.dir={run.root}", "run.resume=auto"))
    save(run, 100)
    with pytest.raises(ConfigError, match=message):
        find_start_point(compose("env=humanoid", f"run.dir={run.root}", "run.resume=auto"))


def test_auto_refuses_other_networks_and_another_seed(run: RunPaths):
    save(run, 100)
    with pytest.raises(ConfigError, match="checkpoint of network widths 8 and 8:4, not 9 and 8:4"):
        find_start_point(config_of(run.root, "algo.policy_hidden_layer_sizes=[9]"))
    with pytest.raises(ConfigError, match="seed=7: a resumed run keeps its seed 0"):
        find_start_point(config_of(run.root, "seed=7"))


def test_auto_leaves_a_folder_with_something_else_alone(tmp_path: Path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ConfigError, match="is no run folder, and not empty"):
        find_start_point(config_of(tmp_path))
    with pytest.raises(ConfigError, match="is no folder"):
        find_start_point(config_of(tmp_path / "thesis.tex"))


def test_auto_needs_a_folder():
    with pytest.raises(ConfigError, match=r"^run\.resume=auto: needs run\.dir or run\.name"):
        compose("env=ant", "run.resume=auto")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("run.max_restarts=-1", "run.max_restarts=-1: must be at least 0"),
        ("run.keep_checkpoints=0", "run.keep_checkpoints=0: must be at least 1"),
        ("run.stop_timeout_s=0", "run.stop_timeout_s=0.0: must be greater than 0"),
    ],
)
def test_bad_values_are_named(override: str, message: str):
    with pytest.raises(ConfigError, match=message):
        compose("env=ant", override)


def test_a_folder_that_exists_is_refused_before_anything_else(run: RunPaths):
    with pytest.raises(ConfigError, match="the run folder exists already"):
        find_start_point(compose("env=ant", f"run.dir={run.root}", "num_envs=auto"))
