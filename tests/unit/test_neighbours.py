"""What the file of a custom task may import, and what it may not take the place of."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from gmijax.errors import ConfigError
from gmijax.sim.adapters import custom, neighbours
from gmijax.sim.registry import make_env


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a task; what a test imports is forgotten after it."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    folder = tmp_path / "tasks"
    folder.mkdir()
    yield folder
    for name in set(sys.modules) - before:
        del sys.modules[name]


def write(file: Path, text: str) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


def test_a_neighbour_comes_before_what_else_is_on_the_path(tmp_path: Path, folder: Path):
    """PYTHONPATH, or the folder of the script that starts the job."""
    for name in ("common_words", "words_of_a_package/__init__"):
        write(tmp_path / f"{name}.py", "WHERE = 'elsewhere'")
        write(folder / f"{name}.py", "WHERE = 'beside'")
    sys.path.insert(0, str(tmp_path))
    with neighbours.importable(folder):
        assert importlib.import_module("common_words").WHERE == "beside"
        assert importlib.import_module("words_of_a_package").WHERE == "beside"
    # The rest of the process goes on as before.
    del sys.modules["common_words"]
    assert importlib.import_module("common_words").WHERE == "elsewhere"


@pytest.mark.parametrize("name", ["colorsys", "antlr4", "fsspec/__init__"])
def test_python_and_installed_packages_come_before_a_neighbour(folder: Path, name: str):
    module = name.partition("/")[0]
    sys.modules.pop(module, None)
    file = write(folder / f"{name}.py", "raise AssertionError('the neighbour')")
    with neighbours.importable(folder):
        assert importlib.import_module(module).__file__ != str(file)


def test_a_folder_of_other_files_is_no_module(tmp_path: Path, folder: Path):
    write(tmp_path / "assets_of_it.py", "WHERE = 'elsewhere'")
    write(folder / "assets_of_it" / "model.xml", "")
    write(folder / "parts" / "legs.py", "COUNT = 4")
    sys.path.insert(0, str(tmp_path))
    with neighbours.importable(folder):
        assert importlib.import_module("assets_of_it").WHERE == "elsewhere"
        assert importlib.import_module("parts.legs").COUNT == 4


def test_a_module_that_is_not_found_says_where_it_may_be(folder: Path):
    task = write(folder / "task.py", "import rewards_of_mine\n")
    with pytest.raises(ConfigError) as error:
        custom.make(f"{task}:make")
    assert str(error.value) == (
        f"env={task} fails: ModuleNotFoundError: No module named 'rewards_of_mine' ({task}:1); "
        "imports are found beside the task, among installed packages and in PYTHONPATH"
    )


def test_numbers_of_64_bit_are_refused_by_who_turned_them_on(folder: Path):
    task = write(
        folder / "task.py",
        "import jax\n\ndef make(*, impl, max_envs):\n"
        "    jax.config.update('jax_enable_x64', True)\n",
    )
    off = "tasks and policies compute with 32 bit, so turn it off"
    try:
        with pytest.raises(ConfigError, match=rf"turned on by env=task\.py:make; {off}"):
            make_env(f"{task}:make")
        assert jax.config.read("jax_enable_x64")
        for name in ("ant", f"{task}:make"):
            with pytest.raises(ConfigError, match=f"turned on by this process; {off}"):
                make_env(name)
    finally:
        jax.config.update("jax_enable_x64", False)
