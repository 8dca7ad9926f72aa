"""The distribution as a user gets it: built, installed elsewhere, used without the checkout."""

from __future__ import annotations

import importlib.metadata
import json
import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import pytest
from packaging.requirements import Requirement
from test_custom_task import SMALL, TASK
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
    """The interpreter of an environment with the wheel and what it declares, without extras.

    Nothing is downloaded: its dependencies, theirs and so on are links to those of the tests.
    GMIJAX_BARE_PYTHON names one in which the wheel was installed by pip.
    """
    if given := os.environ.get("GMIJAX_BARE_PYTHON"):
        return Path(given).absolute()
    root = tmp_path_factory.mktemp("clean") / "env"
    venv.create(root, symlinks=True)
    interpreter = root / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", interpreter]
    run([*pip, "install", "--quiet", "--no-deps", "--no-index", wheel], root)
    site = next(root.glob("lib/python*/site-packages"))
    found = importlib.metadata.distributions(name="gmijax", path=[str(site)])
    for entry in sorted(entries_below(needed_by(next(iter(found))))):
        if not (site / entry.name).exists():
            (site / entry.name).symlink_to(entry)
    return interpreter


def needed_by(
    distribution: importlib.metadata.Distribution, extras: frozenset[str] = frozenset()
) -> dict[str, importlib.metadata.Distribution]:
    """All distributions that pip would install with it, by name."""
    found: dict[str, importlib.metadata.Distribution] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    left = [(distribution, extras)]
    while left:
        one, wanted = left.pop()
        for line in one.requires or ():
            needs = Requirement(line)
            there = needs.marker is None or any(
                needs.marker.evaluate({"extra": extra}) for extra in {"", *wanted}
            )
            key = needs.name.lower(), frozenset(needs.extras)
            if there and key not in seen:
                seen.add(key)
                found[key[0]] = importlib.metadata.distribution(needs.name)
                left.append((found[key[0]], key[1]))
    return found


def entries_below(
    distributions: dict[str, importlib.metadata.Distribution],
) -> Iterator[Path]:
    """The files and folders of site-packages that hold these distributions."""
    for one in distributions.values():
        tops = {file.parts[0] for file in one.files or ()} - {"..", "__pycache__"}
        yield from (Path(str(one.locate_file(top))) for top in tops)


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
    output = run([python, "-m", "gmijax.train", *TINY, steps, "run.dir=run"], tmp_path)
    assert "completed" in output
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["env"], summary["env_steps"]) == ("ball_balance", 2 * STEPS)
    lines = [json.loads(x) for x in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [line["env_steps"] for line in lines] == [STEPS, 2 * STEPS]
    assert all(line["diverged_steps"] == 0 for line in lines)
    assert (tmp_path / "run" / "checkpoints" / f"{2 * STEPS:012d}").is_dir()


def gmijax(python: Path, *words: str, cwd: Path) -> str:
    return run([python.parent / "gmijax", *words], cwd)


@pytest.fixture(scope="module")
def trained(python: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory with a task of the user's own, and `runs/tiny`."""
    home = tmp_path_factory.mktemp("home")
    (home / "point.py").write_text(TASK)
    job = ("env=point.py:make", *SMALL, "num_timesteps=64", "run.name=tiny")
    gmijax(python, "train", *job, cwd=home)
    return home


def test_nothing_but_declared_dependencies_is_there(python: Path, tmp_path: Path):
    absent = ["optuna", "onnxruntime", "brax", "wandb", "gymnasium", "ray", "pytest"]
    code = f"import importlib.util; print([n for n in {absent} if importlib.util.find_spec(n)])"
    assert run([python, "-c", code], tmp_path).strip() == "[]"
    # Of the editable install of the checkout too.
    assert str(CHECKOUT) not in run([python, "-c", "import sys; print(sys.path)"], tmp_path)


def test_a_policy_is_exported_loaded_and_played(python: Path, trained: Path):
    gmijax(python, "export", "run.dir=runs/tiny", "format=stablehlo", cwd=trained)
    (exported,) = trained.glob("runs/tiny/export/*/policy.stablehlo")
    code = f"""
import gmijax, numpy, jax
actions = [gmijax.load_policy(one)(numpy.zeros(1)) for one in ("runs/tiny", {str(exported)!r})]
numpy.testing.assert_allclose(*actions, rtol=1e-6)
program = jax.export.deserialize(bytearray(open({str(exported)!r}, "rb").read()))
print(jax.jit(program.call)(numpy.zeros((2, 1), "float32")).shape)
"""
    assert run([python, "-c", code], trained).strip() == "(2, 1)"
    output = gmijax(python, "play", "run.dir=runs/tiny", "video=none", "num_envs=2", cwd=trained)
    assert "return" in output


def test_what_an_extra_brings_is_named(python: Path, trained: Path):
    for words, extra in (
        (("export", "run.dir=runs/tiny", "format=onnx"), "export"),
        (("train", "env=brax", "env.name=ant"), "brax"),
        (("train", "env=ant", "wandb.mode=offline"), "wandb"),
    ):
        done = subprocess.run(
            [python.parent / "gmijax", *words],
            cwd=trained,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 2
        assert f"pip install 'gmijax[{extra}]'" in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1


def test_commands_without_a_job_say_what_they_know(python: Path, tmp_path: Path):
    assert "ball_balance" in gmijax(python, "list-envs", cwd=tmp_path)
    verbs = ("train", "search", "sweep", "serve", "play", "export")
    code = f"""
from gmijax.__main__ import main
for verb in {verbs}:
    print(verb, main([verb, "--help"]), sep=": ")
"""
    helps = run([python, "-c", code], tmp_path)
    for verb in verbs:
        text, helps = helps.split(f"{verb}: 0\n")
        assert "run.dir" in text


@pytest.mark.slow
def test_commands_with_jobs_of_their_own_work(python: Path, trained: Path):
    job = ("env=point.py:make", *SMALL, "num_timesteps=64")
    gmijax(python, "sweep", *job, "seed=1,2", "run.dir=s", cwd=trained)
    assert json.loads((trained / "s" / "sweep.json").read_text())["jobs"]
    gmijax(python, "serve", "run.dir=runs/tiny", "num_envs=16", "num_timesteps=64", cwd=trained)
    grid = ("search.gmis_per_gpu=[1]", "search.num_envs=[16]")
    gmijax(python, "search", *job, *grid, "search.store=store", "run.dir=found", cwd=trained)
    assert json.loads((trained / "found" / "search.json").read_text())["complete"]
    # It says what the machine lacks: by its exit code too.
    done = subprocess.run(
        [python.parent / "gmijax", "doctor"],
        cwd=trained,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 1)
    assert "Traceback" not in done.stdout + done.stderr
