"""What pyproject.toml asks for is what the package uses."""

from __future__ import annotations

import ast
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from gmijax.control.diagnosis import bindings_fit

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]

# Where a distribution is not named like what is imported of it.
DISTRIBUTIONS = {
    "cuda": "cuda-bindings",
    "hydra": "hydra-core",
    "imageio_ffmpeg": "imageio-ffmpeg",
    "mujoco.mjx": "mujoco-mjx",
    "mujoco_menagerie": "mujoco-menagerie",
    "mujoco_playground": "playground",
    "nccl": "nccl4py",
    "orbax": "orbax-checkpoint",
    "PIL": "pillow",
    "pynvml": "nvidia-ml-py",
}
# What a part of a library imports, and the library does not ask for.
HIDDEN = {"jax.export": "flatbuffers"}
# What jax takes if it is there.
OF_JAX = {"zstandard"}
# Who trains with one of these libraries has it, and what it needs.
USERS_OWN = {"rsl_rl", "stable_baselines3", "tensordict", "torch"}
# jax and its jaxlib, mujoco-mjx and the warp-lang of its kernels, tensorboardX and the protobuf of
# its events are one thing each.
BROUGHT = {"jaxlib": "jax", "warp": "mujoco-mjx", "google": "tensorboardX"}


def requirements(*extras: str) -> dict[str, Requirement]:
    lines = PROJECT["dependencies"] + [line for extra in extras for line in EXTRAS[extra]]
    return {(found := Requirement(line)).name: found for line in lines}


def constants(tree: ast.Module) -> dict[str, str]:
    """Names of a file that stand for a text."""
    found: dict[str, str] = {}
    for node in tree.body:
        match node:
            case (
                ast.Assign(targets=[ast.Name(id=name)], value=ast.Constant(value=str(text)))
                | ast.AnnAssign(target=ast.Name(id=name), value=ast.Constant(value=str(text)))
            ):
                found[name] = text
    return found


def modules_of(node: ast.AST, names_of: dict[str, str]) -> Iterator[str]:
    """Modules that a statement or a call by name imports; `names_of`: constants of its file."""
    match node:
        case ast.Import(names=names):
            yield from (alias.name for alias in names)
        case ast.ImportFrom(module=str(module), names=names, level=0):
            yield module
            yield from (f"{module}.{alias.name}" for alias in names)
        case ast.Attribute(value=ast.Name(id=module), attr=name):
            yield from (used for used in HIDDEN if used == f"{module}.{name}")
        case ast.Call(func=function, args=args):
            name = function.attr if isinstance(function, ast.Attribute) else ""
            handed = [arg for arg in args if isinstance(arg, ast.Attribute)]
            if name in ("import_module", "find_spec") or any(
                arg.attr == "import_module" for arg in handed
            ):
                texts = [str(arg.value) for arg in args if isinstance(arg, ast.Constant)]
                texts += [
                    names_of[arg.id]
                    for arg in args
                    if isinstance(arg, ast.Name) and arg.id in names_of
                ]
                yield from (text for text in texts if text.replace(".", "").isidentifier())


def imported() -> set[str]:
    """Distributions that the package imports from."""
    found: set[str] = set()
    for path in (ROOT / "gmijax").rglob("*.py"):
        tree = ast.parse(path.read_text())
        names_of = constants(tree)
        for node in ast.walk(tree):
            for module in modules_of(node, names_of):
                top = module.partition(".")[0]
                if top == "gmijax" or top in sys.stdlib_module_names:
                    continue
                if module in HIDDEN:
                    found.add(HIDDEN[module])
                name = BROUGHT.get(top, top)
                found.add(DISTRIBUTIONS.get(module, DISTRIBUTIONS.get(name, name)))
    return found


@pytest.mark.parametrize(
    ("cuda", "fits", "does_not"),
    [
        (12, ("12.9.1", "12.9.10"), ("12.8.0", "12.9.0", "13.0.0")),
        (13, ("13.0.0", "13.5.0"), ("12.9.10",)),
    ],
)
def test_cuda_extras_bring_the_fast_path(cuda: int, fits: tuple[str], does_not: tuple[str]):
    wanted = requirements(f"cuda{cuda}")
    assert wanted["jax"].extras == {f"cuda{cuda}"}
    bindings = wanted["cuda-bindings"].specifier
    for version in fits:
        assert bindings.contains(version)
        assert bindings_fit(version, cuda)
    for version in does_not:
        assert not bindings.contains(version)
        assert not bindings_fit(version, cuda)


def test_mujoco_and_mjx_are_a_pair():
    wanted = requirements()
    assert wanted["mujoco"].specifier == wanted["mujoco-mjx"].specifier
    assert requirements("warp")["mujoco-mjx"].specifier == wanted["mujoco"].specifier
    # Its Newton solver has a wrong Hessian.
    assert not wanted["mujoco"].specifier.contains("4.0.0")


def test_every_declared_dependency_is_imported():
    users_own = [extra for extra in EXTRAS if extra not in ("test", "dev", "docs")]
    assert requirements(*users_own).keys() - imported() == OF_JAX


def test_every_import_is_declared():
    users_own = [extra for extra in EXTRAS if extra not in ("test", "dev", "docs")]
    assert imported() - requirements(*users_own).keys() == USERS_OWN
