"""Children are of the gmijax that starts them, and import nothing from the working directory."""

from __future__ import annotations

import json
import os
import shutil
import site
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import gmijax
from gmijax.machine import child_start, interpreter

PACKAGE = Path(gmijax.__file__).resolve().parent

PROBE = """
import json, queue, random, statistics, sys, gmijax
print(json.dumps([gmijax.__file__, random.__file__, sys.path, sys.argv[1:]]))
"""


def run(command: list[str], cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        cwd=cwd,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def probe(command: list[str], cwd: Path, **variables: str) -> tuple[str, str, list[str], Any]:
    done = run(command, cwd, **variables)
    assert done.returncode == 0, done.stderr
    return tuple(json.loads(done.stdout))


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A working directory with files named as modules that a child needs."""
    folder = tmp_path / "hostile"
    for name in ("random", "queue", "statistics", "runpy", "optax", "gmijax/__init__"):
        file = folder / f"{name}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("raise SystemExit('wrong module')\n")
    return folder


@pytest.fixture
def probe_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "of the script"
    folder.mkdir()
    (folder / "probe.py").write_text(PROBE)
    return folder


def test_nothing_of_the_working_directory_is_imported(
    hostile: Path, probe_folder: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.syspath_prepend(str(probe_folder))
    ours, of_python, path, arguments = probe(interpreter.command("probe", "one", "--two"), hostile)
    assert Path(ours).parent == PACKAGE
    assert Path(of_python).parent == Path(os.__file__).parent
    assert str(hostile) not in path
    assert "" not in path
    assert arguments == ["one", "--two"]


def test_a_folder_of_the_parents_path_takes_the_place_of_nothing(
    hostile: Path, probe_folder: Path, monkeypatch: pytest.MonkeyPatch
):
    """As when the parent is `python -m`, or a script beside such files."""
    monkeypatch.syspath_prepend(str(probe_folder))
    monkeypatch.syspath_prepend(str(hostile))
    ours, of_python, path, _ = probe(interpreter.command("probe"), hostile)
    assert Path(ours).parent == PACKAGE
    assert Path(of_python).parent == Path(os.__file__).parent
    assert path.index(str(hostile)) > path.index(str(Path(os.__file__).parent))


def test_a_child_is_of_the_checkout_that_only_the_working_directory_led_to(tmp_path: Path):
    package = tmp_path / "checkout" / "gmijax"
    (package / "machine").mkdir(parents=True)
    for name in ("__init__.py", "version.py", "machine/__init__.py"):
        shutil.copy(PACKAGE / name, package / name)
    for module in (interpreter, child_start):
        shutil.copy(str(module.__file__), package / "machine")
    (package / "probe.py").write_text(PROBE)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    code = (
        "import os, subprocess; from gmijax.machine.interpreter import command; "
        f"os.chdir({str(elsewhere)!r}); subprocess.run(command('gmijax.probe'), check=True)"
    )
    ours, *_ = probe([sys.executable, "-c", code], package.parent, PYTHONPATH="")
    assert Path(ours).parent == package


def test_a_package_that_was_replaced_meanwhile_is_named(tmp_path: Path):
    command = interpreter.command("gmijax.list_envs")
    command[command.index(gmijax.__version__)] = "0.0.9"
    done = run(command, tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == (
        f"{PACKAGE} holds gmijax {gmijax.__version__} by now, and this process was started by "
        "gmijax 0.0.9: start the command again\n"
    )


def test_what_a_fresh_interpreter_has_by_itself_is_not_added(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(("", "/named", "/named/too")))
    (tmp_path / "a:b").mkdir()
    # Not this process's path: packages that other tests import, such as ray, add to it.
    code = "import json, sys; print(json.dumps(sys.path))"
    fresh = run([sys.executable, "-S", "-c", code], tmp_path, PYTHONPATH="")
    of_python = [*json.loads(fresh.stdout), *site.getsitepackages()]
    path = ["", "/named", *of_python, str(tmp_path / "gone"), str(tmp_path / "a:b")]
    # '' is the working directory, also after a change of it.
    assert interpreter.added_paths(path) == [str(tmp_path)]


def test_every_child_is_started_this_way():
    others = [
        file.name
        for file in PACKAGE.rglob("*.py")
        if "sys.executable" in file.read_text() and file.name != "interpreter.py"
    ]
    assert others == []
