"""Keys of earlier versions: one line on a command line, and nothing in a saved configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from supervision import save

from gmijax import compose
from gmijax.cli.answers import COMMANDS
from gmijax.cli.compose import defaults
from gmijax.config.removed import REMOVED
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths, write_json

HARMLESS = [
    (key, value)
    for key, removed in REMOVED.items()
    for value in (("any",) if removed.harmless is None else removed.harmless)
    if key != "output.compress"  # Of serving, which saves nothing to go on from.
]


def _run_with(folder: Path, key: str, value: Any) -> RunPaths:
    run = RunPaths(folder / "old")
    save(run, 100)
    saved = to_dict(compose("env=ant"))
    group, _, name = key.rpartition(".")
    saved.setdefault(group, {})[name] = value
    write_json(run.config, saved)
    return run


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("train", "reduce.selection=paper"),
        ("train", "+plan.mps_priority=trainers_first"),
        ("train", "~reduce.intra"),
        ("search", "search.iterations=3"),
        ("serve", "output.compress=true"),
    ],
)
def test_the_error_of_a_removed_key_has_what_to_write_now(command: str, text: str) -> None:
    key = text.strip("+~").partition("=")[0]
    policy = ["policy=random"] if command == "serve" else []
    with pytest.raises(ConfigError) as error:
        compose("env=ant", text, *policy, command=command)  # pyright: ignore[reportCallIssue]
    assert str(error.value) == f"{key}: removed; {REMOVED[key].write}"


def test_no_command_has_a_removed_key() -> None:
    for command in COMMANDS.keys() - {"pack"}:
        assert not REMOVED.keys() & defaults(command, ()).keys()


@pytest.mark.parametrize(("key", "value"), HARMLESS)
def test_a_run_that_had_its_default_goes_on(key: str, value: Any, tmp_path: Path) -> None:
    run = _run_with(tmp_path, key, value)
    assert compose(f"run.resume={run.root}").run.resume == str(run.root)


@pytest.mark.parametrize("key", [key for key, one in REMOVED.items() if one.harmless is not None])
def test_a_run_that_was_trained_otherwise_is_refused_by_the_key(key: str, tmp_path: Path) -> None:
    run = _run_with(tmp_path, key, "other")
    with pytest.raises(ConfigError, match=f"does not know: {key};"):
        compose(f"run.resume={run.root}")


def test_the_error_of_a_run_of_sac_with_an_agent_of_its_own_has_what_to_write(
    tmp_path: Path,
) -> None:
    run, key = RunPaths(tmp_path / "old"), "plan.serving_gmis_per_gpu"
    save(run, 100)
    saved = to_dict(compose("env=ant", "algo=sac", "num_envs=1024"))
    saved["plan"]["serving_gmis_per_gpu"] = 1
    write_json(run.config, saved)
    with pytest.raises(ConfigError, match=rf"/old/config\.json: {key}=1: .* write {key}=null$"):
        compose(f"run.resume={run.root}")
    assert not compose(f"run.resume={run.root}", f"{key}=null").is_decoupled
