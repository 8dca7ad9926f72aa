"""Tasks in files of the user's own: how they are named, found, loaded and checked."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

import gmijax
from gmijax.errors import ConfigError
from gmijax.sim.registry import make_env
from gmijax.sim.source import changes, pinned, reference, split

EXAMPLE = Path(__file__).parents[2] / "examples" / "custom_task.py"

TASK = """
import jax.numpy as jnp
from gmijax.sim import episode
from gmijax.sim.interface import Env, EnvSpec

SPEC = EnvSpec("point", 2, 1, 0.1, 20, ("near",))

def make(*, impl, max_envs):
    def reset(model, key):
        return episode.begin(SPEC, jnp.zeros(2), (), jnp.zeros(2), key)

    def step(model, state, action):
        moved = state.physics + action[0]
        reward = -moved[0], {"near": -moved[0]}
        return episode.advance(state, moved, (), moved, reward, moved[0] > 3.0)

    return Env(SPEC, (), reset, step, None, lambda state: state.physics)
"""

READS_MODEL = """from mujoco import MjModel
    MjModel.from_xml_string("<mujoco>{}</mujoco>")
    return Env("""


def written(folder: Path, text: str) -> str:
    (folder / "point.py").write_text(text)
    return f"{folder / 'point.py'}:make"


def imported(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("imported_task", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["imported_task"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def outer_function() -> object:
    def inner() -> None: ...

    return inner


def test_a_task_in_a_file_is_made_with_its_own_length(tmp_path: Path):
    env = make_env(written(tmp_path, TASK))
    assert env.spec[:5] == ("point", 2, 1, 0.1, 20)
    assert make_env(written(tmp_path, TASK), episode_length=7).spec.episode_length == 7


def test_sizes_may_be_integers_of_numpy(tmp_path: Path):
    # As `mj_model.sensor_dim.sum()` is.
    sizes = 'SPEC = EnvSpec("point", np.int64(2), np.int32(1), 0.1, np.int64(20), ("near",)'
    text = TASK.replace('SPEC = EnvSpec("point", 2, 1, 0.1, 20, ("near",)', sizes)
    spec = make_env(written(tmp_path, f"import numpy as np\n{text}")).spec
    sizes_of = (spec.obs_size, spec.action_size, spec.episode_length)
    assert [*map(type, sizes_of)] == [int] * 3
    assert sizes_of == (2, 1, 20)
    seen = text.replace('("near",))', '("near",), actor_obs_size=np.int64(1))')
    assert make_env(written(tmp_path, f"import numpy as np\n{seen}")).spec.actor_obs_size == 1
    with pytest.raises(ConfigError, match=r"spec\.obs_size=2\.0: must be an integer"):
        make_env(written(tmp_path, TASK.replace('"point", 2', '"point", 2.0')))


def test_a_task_gets_the_weights_and_settings_that_it_takes(tmp_path: Path):
    name = written(tmp_path, TASK.replace("impl, max_envs", "impl, max_envs, settings"))
    with pytest.raises(ConfigError, match=r"^env\.rewards: .*no argument `rewards` to take it$"):
        make_env(name, rewards={"near": 2.0}, settings={"length": 7})
    taken = TASK.replace("impl, max_envs", "impl, max_envs, settings").replace(
        "    return Env(", "    assert settings == {'length': 7}\n    return Env("
    )
    make_env(written(tmp_path, taken), settings={"length": 7})


def test_a_curriculum_needs_a_task_that_carries_something_on(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"^env\.curriculum: .* no argument `curriculum` to"):
        make_env(written(tmp_path, TASK), curriculum=True)
    without_curriculum = TASK.replace("impl, max_envs", "impl, max_envs, curriculum=False")
    with pytest.raises(ConfigError, match=r"^env\.curriculum=on: point has no next_episode"):
        make_env(written(tmp_path, without_curriculum), curriculum=True)


def test_a_task_may_import_what_lies_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "beside_the_task.py").write_text("WEIGHT = 2.0\n")
    make_env(written(tmp_path, f"from beside_the_task import WEIGHT\n{TASK}"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("def make(", "def mak(", r"no function make there: did you mean mak\?$"),
        # Not what it imports.
        ("def make(", "from os.path import join\ndef start(", r"there; allowed: start$"),
        (
            "return Env(",
            "assert False\n    return Env(",
            r"fails: AssertionError \(.*point\.py:\d+\)$",
        ),
        (
            "return Env(",
            READS_MODEL.format("<optoin/>"),
            r"unrecognized element; Element 'optoin', line 1 \(.*point\.py:\d+\)$",
        ),
        (
            "return Env(",
            READS_MODEL.format("<a>"),
            r"ValueError: XML parse error \d+: .*MISMATCHED.* \(.*point\.py:\d+\)$",
        ),
        ("def make(", "def make(:", r"point\.py fails: SyntaxError: .*line 8\)$"),
        (
            "import jax.",
            "import jaxx.",
            r"ModuleNotFoundError: .*'jaxx'.*point\.py:2\); imports are found beside",
        ),
        ("impl, max_envs", "impl", r"TypeError: .*unexpected keyword argument 'max_envs'$"),
        ("return Env(SPEC", "return Env(None", r"spec: expected an EnvSpec, got NoneType"),
        ("return Env(", "return (", r"expected a gmijax\.sim\.interface\.Env, got tuple$"),
        ('"point", 2', '"point", 0', r"spec\.obs_size=0: must be an integer of at least 1$"),
        ("0.1,", "0.0,", r"spec\.control_dt_s=0\.0: must be a number of seconds greater than 0$"),
        ("0.1,", "'fast',", r"spec\.control_dt_s='fast': must be a number of seconds greater th"),
        ('"point", 2', '"point", 3', r"obs is float32\[2\], not float32\[3\]$"),
        (
            "state, moved,",
            "state, moved.astype(int),",
            r"physics is int32\[2\], not float32\[2\]$",
        ),
        ('{"near"', '{"far"', r"step does not give .*: reward_terms\.far is float32\[\], not "),
        ("moved[0] > 3.0)", "moved[0])", r"terminated is float32\[\], not bool\[\]$"),
        ("state, moved,", "state, moved[:1],", r"but physics is float32\[1\], not float32\[2\]$"),
        ("jnp.zeros(2), (), jnp.zeros(2)", "jnp.zeros(2) / 0, (), jnp.zeros(2)", r"in physics$"),
        ("(), jnp.zeros(2)", "(), jnp.full(2, 1e9)", r"an observation of 1e\+09, and spec\.max_"),
        ("state.physics + a", "state.phsics + a", r"AttributeError: .*'phsics'.*point\.py:13\)$"),
        ("state: state.physics)", "state: state.physics[0])", r"qpos has shape \(\), not a vect"),
    ],
)
def test_what_is_wrong_with_a_task_is_an_error_of_one_line(
    tmp_path: Path, old: str, new: str, message: str
):
    assert TASK.count(old) >= 1
    with pytest.raises(ConfigError, match=message) as error:
        make_env(written(tmp_path, TASK.replace(old, new)))
    assert "\n" not in str(error.value)
    assert "point.py" in str(error.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("x.py", "expected PATH.py:FUNCTION"),
        ("x.py:", "expected PATH.py:FUNCTION"),
        ("x.txt:make", "expected PATH.py:FUNCTION"),
        ("nowhere/x.py:make", "^env=nowhere/x.py:make: no such file$"),
    ],
)
def test_a_name_is_a_file_and_a_function(name: str, message: str):
    with pytest.raises(ConfigError, match=message):
        split(name)


def test_a_function_of_a_file_is_a_task_of_the_library():
    make = imported(EXAMPLE).make
    assert reference(make) == f"{EXAMPLE}:make"
    config = gmijax.compose("num_envs=8", env=make)
    assert (config.env.suite, config.env.name) == ("custom", f"{EXAMPLE}:make")
    assert (config.env.label, config.env.slug) == ("custom_task.py:make", "custom_task")


def test_what_other_processes_cannot_find_is_no_task():
    typed: dict[str, object] = {"__name__": "__main__"}
    exec("def make(): ...", typed)
    typed["make"].__module__ = "nowhere_to_be_found"
    for make, message in (
        (lambda: None, "<lambda>: not a function at the top level"),
        (outer_function(), "inner: not a function at the top level"),
        (typed["make"], "make: not in a file; GMIs are processes of their own"),
    ):
        with pytest.raises(ConfigError, match=message):
            reference(make)


def test_a_run_notes_the_absolute_path_and_the_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    written(tmp_path, TASK)
    monkeypatch.chdir(tmp_path)
    config = gmijax.compose("env=point.py:make").env
    first = pinned(config)
    assert first.name == f"{tmp_path}/point.py:make"
    saved = {"source_sha256": first.source_sha256}
    assert changes(pinned(config), saved) is None
    written(tmp_path, TASK + "# changed\n")
    with pytest.raises(
        ConfigError, match=r"point\.py has changed since .* To use .* add env=point\.py:make$"
    ):
        pinned(first)
    assert (
        changes(pinned(config), saved) == "custom task: point.py:make has changed since the "
        "run was started"
    )


def test_tasks_of_other_suites_have_no_file():
    theirs = gmijax.compose("env=playground", "env.name=Cartpole").env
    assert pinned(theirs) == theirs
    assert changes(theirs, {}) is None
    assert (theirs.label, theirs.slug) == ("playground/Cartpole", "playground-Cartpole")
    assert theirs.episode_length is None
