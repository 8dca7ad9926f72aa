"""How the package of MuJoCo Playground is imported."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from gmijax.errors import ConfigError
from gmijax.sim.adapters.playground_package import import_playground

PACKAGE = "mujoco_playground"


def _taken_out() -> dict[str, ModuleType]:
    """Modules of Playground and PyTorch, which are imported no longer."""
    names = [name for name in sys.modules if name.split(".")[0] in (PACKAGE, "torch")]
    return {name: sys.modules.pop(name) for name in names}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where packages are found first, with none of Playground's imported before or after."""
    before = _taken_out()
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    _taken_out()
    sys.modules.update(before)


def test_pytorch_is_imported_when_its_wrapper_is_used(folder: Path):
    files = {
        "torch.py": "",
        f"{PACKAGE}/__init__.py": f"from {PACKAGE}._src import wrapper_torch",
        f"{PACKAGE}/_src/__init__.py": "",
        f"{PACKAGE}/_src/mjx_env.py": "",
        f"{PACKAGE}/_src/wrapper_torch.py": "import torch\nWRAPPER = torch.__name__",
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    finders = list(sys.meta_path)
    package = import_playground()
    assert "torch" not in sys.modules
    assert sys.meta_path == finders
    assert package.wrapper_torch.WRAPPER == "torch"
    assert "torch" in sys.modules


def test_a_package_that_cannot_be_imported_is_one_line(folder: Path):
    (folder / PACKAGE).mkdir()
    (folder / PACKAGE / "__init__.py").write_text("import missing_package")
    finders = list(sys.meta_path)
    with pytest.raises(ConfigError, match=r"^env=playground fails: .*missing_package"):
        import_playground()
    assert sys.meta_path == finders
