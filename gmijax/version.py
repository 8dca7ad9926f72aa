"""The version of gmijax, from which the distribution takes it, and of other packages."""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, requires, version

__version__ = "0.1.0"


def versions_of(packages: Iterable[str]) -> dict[str, str | None]:
    """Versions of installed packages by name, None for what is not installed."""
    found: dict[str, str | None] = {}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found


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
