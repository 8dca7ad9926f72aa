"""The YAML files behind the keys."""

from __future__ import annotations

from pathlib import Path

import gmijax


def config_dir() -> Path:
    """The folder of YAML files: inside an installed package, or beside it in a checkout."""
    package = Path(gmijax.__file__).resolve().parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def choices(group: str) -> list[str]:
    """Names of the YAML files of a group, e.g. the tasks for `env`."""
    # No path of the user's making: it could lead anywhere, or be too long for a file system.
    folders = [path for path in config_dir().iterdir() if path.name == group]
    return sorted(path.stem for folder in folders for path in folder.glob("*.yaml"))
