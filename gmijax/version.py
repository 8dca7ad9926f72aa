"""The version of gmijax, from which the distribution takes it, and of Python and packages."""

from __future__ import annotations

import platform
import re
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, requires, version

__version__ = "0.1.0"


def versions_of(packages: Iterable[str]) -> dict[str, str | None]:
    """Versions of `gmijax`, `python` and packages by name, None for what is not installed."""
    return {package: _version_of(package) for package in packages}


def _version_of(package: str) -> str | None:
    if package == "gmijax":
        return __version__  # Of the code that runs, which need not be what is installed.
    if package == "python":
        return platform.python_version()
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def numbers_of(number: str | None) -> tuple[int, ...]:
    """The first three numbers of a version, to compare by: (0, 11, 1) of `0.11.1.dev3`."""
    return tuple(map(int, re.findall(r"\d+", number or "")[:3]))


def pinned_version(package: str, dependency: str) -> str | None:
    """The one version of `dependency` that an installed package asks for, else None."""
    try:
        wanted = requires(package) or []
    except PackageNotFoundError:
        return None
    named = (line.partition(";")[0].replace(" ", "") for line in wanted)
    return next((x.partition("==")[2] for x in named if x.startswith(f"{dependency}==")), None)
