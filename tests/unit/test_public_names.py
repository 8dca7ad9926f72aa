"""The names that users import."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Callable

import pytest

import gmijax
from gmijax.errors import ConfigError


def test_every_public_name_can_be_had() -> None:
    assert sorted(gmijax.__all__) == dir(gmijax)
    for name in gmijax.__all__:
        assert getattr(gmijax, name) is not None


def test_a_function_stays_what_it_is_when_the_command_of_its_name_is_imported() -> None:
    for name in ("train", "serve", "search", "sweep"):
        assert callable(importlib.import_module(f"gmijax.{name}").main)
        assert getattr(gmijax, name).__name__ == name


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gmijax.train("env=ant"), "config='env=ant': expected a TrainConfig; gmijax.comp"),
        (lambda: gmijax.search(None), "config=None: expected a TrainConfig"),
        (lambda: gmijax.serve(gmijax.compose()), "config=TrainConfig.*: expected a ServeConfig"),
        (lambda: gmijax.sweep(gmijax.compose()), "configs: expected a list of configurations"),
        (lambda: gmijax.sweep(["seed=0"]), "config='seed=0': expected a TrainConfig"),
        (lambda: gmijax.compose(5), "5: expected key=value"),
        (lambda: gmijax.make_env(None), "name=None: expected the name of a task"),
        (lambda: gmijax.make_vector_env(5, 2), "name=5: expected the name of a task"),
    ],
)
def test_what_is_of_another_type_is_refused_in_one_line(
    call: Callable[[], object], message: str
) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        call()


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = getattr(gmijax, "trian")  # noqa: B009


def test_the_controller_loads_neither_jax_nor_mujoco() -> None:
    commands = ("train", "serve", "search", "sweep", "play", "export", "doctor")
    others = ("demo", "list_envs", "__main__")
    modules = ", ".join(("gmijax", *(f"gmijax.{name}" for name in (*commands, *others))))
    code = f"import {modules}, sys; print({{'jax', 'mujoco', 'flax'}} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
