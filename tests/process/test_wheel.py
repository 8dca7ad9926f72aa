"""The distribution as a user gets it: built, installed elsewhere, used without the checkout."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import pytest
from training_jobs import STEPS, TINY

CHECKOUT = Path(__file__).resolve().parents[2]
COMMAND_TIMEOUT_S = 180

pytestmark = pytest.mark.timeout(400)


def run(command: Sequence[str | Path], cwd: Path) -> str:
    """Runs a command away from the checkout, and returns its standard output."""
    inherited = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=inherited,
        capture_output=True,
        text=True,
        timeout=COMMAND_TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, f"{command} failed:\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist, and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("dist")
    # Without isolation nothing is downloaded; without --wheel the wheel is made from the sdist,
    # so that a file which the sdist lacks is missed.
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, CHECKOUT], folder)
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    return next(dist.glob("gmijax-*.whl"))


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with the wheel and today's dependencies."""
    root = tmp_path_factory.mktemp("clean") / "env"
    venv.create(root, symlinks=True)
    interpreter = root / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", interpreter]
    run([*pip, "install", "--quiet", "--no-deps", "--no-index", wheel], root)
    here = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    # A .pth file in a folder that a .pth file names is not read: the dependencies are shared,
    # an editable install of the checkout is not.
    site = next(root.glob("lib/python*/site-packages"))
    (site / "dependencies.pth").write_text("\n".join(sorted(here)) + "\n")
    return interpreter


def files_below(folder: str, pattern: str = "*") -> set[str]:
    """Files of the checkout, relative to it; caches left out."""
    return {
        path.relative_to(CHECKOUT).as_posix()
        for path in (CHECKOUT / folder).rglob(pattern)
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_wheel_holds_code_configs_and_assets_and_nothing_else(wheel: Path):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    configs = {f"gmijax/{name}" for name in files_below("configs")}
    assert names == files_below("gmijax") | configs


def test_sdist_holds_what_a_developer_needs(dist: Path):
    with tarfile.open(next(dist.glob("gmijax-*.tar.gz"))) as archive:
        names = {str(PurePosixPath(*PurePosixPath(name).parts[1:])) for name in archive.getnames()}
    wanted = {".ci/run", ".pre-commit-config.yaml", "LICENSE", "Makefile", "tests/conftest.py"}
    assert wanted | files_below("configs") | files_below("tests", "*.py") <= names


def test_import_comes_from_the_wheel_and_loads_no_jax(python: Path, tmp_path: Path):
    code = """
        import sys
        import gmijax, gmijax.train
        loaded = sorted({"jax", "mujoco", "flax", "optax"} & sys.modules.keys())
        print(gmijax.__file__, sys.modules["gmijax.train"].__file__, loaded, sep="\\n")
    """
    lines = run([python, "-c", "\n".join(map(str.strip, code.splitlines()))], tmp_path)
    package, module, loaded = lines.split("\n")[:3]
    environment = python.parents[1].resolve()
    assert Path(package).resolve().is_relative_to(environment)
    assert Path(module).resolve().is_relative_to(environment)
    assert loaded == "[]", "the controller must not hold a GPU context"


def test_train_help_lists_keys_outside_the_checkout(python: Path, tmp_path: Path):
    text = run([python, "-m", "gmijax.train", "--help"], tmp_path)
    for key in ("num_timesteps", "plan.gmis_per_gpu", "algo.learning_rate", "run.dir"):
        assert key in text
    assert run([python.parent / "gmijax", "train", "--help"], tmp_path) == text
    assert list(tmp_path.iterdir()) == [], "--help must leave nothing behind"


def test_it_trains_outside_the_checkout(python: Path, tmp_path: Path):
    steps = f"num_timesteps={2 * STEPS}"
    said = run([python, "-m", "gmijax.train", *TINY, steps, "run.dir=run"], tmp_path)
    assert "completed" in said
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["env"], summary["env_steps"]) == ("ball_balance", 2 * STEPS)
    lines = [json.loads(x) for x in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [line["env_steps"] for line in lines] == [STEPS, 2 * STEPS]
    assert all(line["diverged_steps"] == 0 for line in lines)
    assert (tmp_path / "run" / "checkpoints" / f"{2 * STEPS:012d}").is_dir()
