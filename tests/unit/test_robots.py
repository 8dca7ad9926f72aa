"""`env=go1` and others before a process is started: names, settings, models, what is refused."""

from __future__ import annotations

import dataclasses
import re
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from made_checkpoint import make_run

import gmijax
from gmijax.cli.groups import choices
from gmijax.config.env import ROBOTS
from gmijax.control.features import features
from gmijax.errors import ConfigError
from gmijax.sim.impl import choose_impl
from gmijax.sim.registry import draws_models, require_env
from gmijax.sim.robot_models import PACKAGE, find_model, models_of
from gmijax.sim.robots import ROBOT_SETTINGS
from gmijax.sim.tasks.settings import settings_from

TASKS_PAGE = (Path(__file__).parents[2] / "docs" / "tasks.md").read_text()


def module_that_is_installed(name: str) -> ModuleType:
    module = ModuleType(name)
    module.__spec__ = ModuleSpec(name, None)
    return module


@pytest.fixture(autouse=True)
def playground(monkeypatch: pytest.MonkeyPatch) -> None:
    """Playground is here, and no models are."""
    name = "mujoco_playground"
    monkeypatch.setitem(sys.modules, name, module_that_is_installed(name))
    monkeypatch.setenv("MENAGERIE_ROOT", "/nowhere")


def refused(*overrides: str) -> str:
    """The error of a command line that is refused."""
    with pytest.raises(ConfigError) as error:
        require_env(gmijax.compose(*overrides).env)
    return str(error.value)


def make_model(root: Path, name: str) -> Path:
    (root / name / "assets").mkdir(parents=True)
    (root / name / "assets" / "trunk.stl").touch()
    return root / name


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_is_a_task_of_playground_with_a_name_of_ours(name: str) -> None:
    config = gmijax.compose(f"env={name}")
    env = config.env
    assert (env.suite, env.name, env.label, env.slug) == ("playground", name, name, name)
    assert env.episode_length == 1000
    assert env.settings == vars(settings_from(ROBOT_SETTINGS[name], {}))
    assert {"tracking_lin_vel", "tracking_ang_vel", "termination"} <= env.rewards.keys()
    assert config.num_envs == 8192, "its own settings are chosen"
    assert choose_impl("auto", "cuda", name, warp_installed=True)[0] == "warp"
    assert models_of(ROBOTS[name])
    assert name in choices("env")


def test_names_of_playground_stay() -> None:
    env = gmijax.compose("env=playground", "env.name=Go1JoystickFlatTerrain").env
    assert (env.label, env.slug) == (
        "playground/Go1JoystickFlatTerrain",
        "playground-Go1JoystickFlatTerrain",
    )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("env.rewards.torqes=0", "unknown key env.rewards.torqes: did you mean torques?"),
        ("+env.rewards.torqes=1", "unknown key env.rewards.torqes: did you mean torques?"),
        ("env.settings.noize=0", "unknown key env.settings.noize: did you mean noise?"),
        ("env.settings.noise=-1", "env.settings.noise=-1.0: must be at least 0"),
        ("env.settings.push=0.5", "env.settings.push=0.5: must be 0 or 1"),
        (
            "env.settings.push_min_m_per_s=3",
            "env.settings.push_min_m_per_s=3.0: must be at most env.settings.push_max_m_per_s=2.0",
        ),
        (
            "env.settings.command_left_min_m_per_s=1",
            "env.settings.command_left_min_m_per_s=1.0: must be at most "
            "env.settings.command_left_max_m_per_s=0.5",
        ),
        (
            "env.randomize=episode",
            "env.randomize=episode: not with env=g1, whose episodes all begin with the first "
            "start of their environment; allowed: off, on",
        ),
        (
            "+env.randomization.body_mass={operation: scale, range: [1,2]}",
            "env.randomization.body_mass: not with env=g1; tasks of Playground bring what they "
            "draw, or draw nothing",
        ),
        ("env.curriculum=on", "env.curriculum=on: g1 has none; allowed: anymal"),
        ("env.name=go1", "env.name=go1: choose the task with env=go1"),
        ("seed=0", "env=g1: MENAGERIE_ROOT=/nowhere has no model unitree_g1 (docs/tasks.md)"),
    ],
)
def test_what_a_robot_cannot_have_is_one_line(overrides: str, message: str) -> None:
    assert refused("env=g1", overrides).startswith(message)


def test_a_robot_by_its_long_name_has_no_other_terms() -> None:
    message = refused("env=playground", "env.name=Go1JoystickFlatTerrain", "env.rewards.torqes=1")
    assert message == "unknown key env.rewards.torqes: did you mean torques?"


def test_commands_of_go1_have_no_negative_amplitude() -> None:
    message = "env.settings.command_yaw_rad_per_s=-1.0: must be at least 0"
    assert refused("env=go1", "env.settings.command_yaw_rad_per_s=-1") == message


@pytest.mark.parametrize("name", ["spot", "playground env.name=CartpoleBalance"])
def test_a_task_without_a_randomiser_is_not_randomised(name: str) -> None:
    label = name.replace(" env.name=", "/")
    assert refused(*f"env={name} env.randomize=on".split()) == (
        f"env.randomize=on: Playground has no randomisation for {label}; allowed: off"
    )
    assert draws_models(gmijax.compose("env=t1_rough").env)


def test_where_playground_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert refused("env=go1") == (
        "env=go1: needs the package mujoco_playground (pip install 'gmijax[playground]')"
    )


def test_the_error_of_a_missing_model_has_the_command_that_gets_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("MENAGERIE_ROOT")
    menagerie = module_that_is_installed(PACKAGE)
    cache = SimpleNamespace(
        is_cached=lambda robot: (tmp_path / robot / ".complete").exists(),
        model_path=lambda robot: tmp_path / robot,
    )
    menagerie.__dict__.update(Cache=lambda: cache, names=lambda: ["unitree_go1"], get=str)
    monkeypatch.setitem(sys.modules, PACKAGE, menagerie)
    message = (
        "env=go1: the model of unitree_go1 is not here; get with: mujoco-menagerie prefetch "
        "unitree_go1 (without internet: docs/tasks.md)"
    )
    assert refused("env=go1") == message
    folder = make_model(tmp_path, "unitree_go1")
    assert refused("env=go1") == message, "half of a download"
    (folder / ".complete").touch()
    require_env(gmijax.compose("env=go1").env)


def test_a_model_is_looked_for_where_menagerie_root_says(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    (tmp_path / "unitree_g1" / "assets").mkdir(parents=True)
    assert find_model("unitree_g1") is None, "an empty folder"
    assert find_model("unitree_go1") is None
    folder = make_model(tmp_path, "unitree_go1")
    assert find_model("unitree_go1") == folder
    require_env(gmijax.compose("env=go1_rough").env)
    # These models are not meshes alone, and not of this robot.
    assert models_of("PandaRobotiqPushCube") == ("franka_emika_panda", "robotiq_2f85_v4")
    assert models_of("CheetahRun") == ()


def test_the_doctor_knows_which_models_are_missing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    for name in ("boston_dynamics_spot", "unitree_g1", "unitree_go1"):
        make_model(tmp_path, name)
    [found] = [feature for feature in features({}, None) if feature.name == "robot models"]
    assert found[1:] == (
        False,
        f"MENAGERIE_ROOT={tmp_path} has no model booster_t1 (docs/tasks.md)",
    )
    make_model(tmp_path, "booster_t1")
    [found] = [feature for feature in features({}, None) if feature.name == "robot models"]
    assert found.usable


def test_a_run_of_a_robot_goes_on_as_one(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", "env=g1", "env.settings.noise=0.5")
    env = gmijax.compose(f"run.resume={run.root}", "env.rewards.alive=1").env
    assert (env.name, env.settings["noise"], env.rewards["alive"]) == ("g1", 0.5, 1.0)


def test_settings_of_other_tasks_have_the_names_of_their_groups(tmp_path: Path) -> None:
    task = ("env=playground", "env.name=Go1Getup")
    run = make_run(tmp_path / "run", *task, "env.settings.noise_config.level=0.5")
    env = gmijax.compose(f"run.resume={run.root}", "env.settings.noise_config.level=2").env
    assert env.settings == {"noise_config.level": 2.0}
    env = gmijax.compose(f"run.resume={run.root}", "env.rewards.torques=2").env
    assert (env.settings, env.rewards) == ({"noise_config.level": 0.5}, {"torques": 2.0})


def test_settings_in_the_documents_are_those_of_the_code() -> None:
    rows = re.findall(
        r"^\| `(\w+)` \| (.*) \|$", TASKS_PAGE.partition("## Robots")[2], re.MULTILINE
    )
    documented = [(name, cells.split(" | ")) for name, cells in rows if cells.count(" | ") == 4]
    for column, name in enumerate(("go1", "g1", "t1", "spot"), 1):
        fields = dataclasses.fields(ROBOT_SETTINGS[name])
        found = {key: cells for key, cells in documented if cells[column].strip()}
        assert {key: (cells[0], float(cells[column])) for key, cells in found.items()} == {
            field.name: (field.metadata["doc"], field.default) for field in fields
        }
