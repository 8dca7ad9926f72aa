"""Whether what the viewer is made of is installed. Imports nothing."""

from __future__ import annotations

import importlib.util
from typing import Final

PACKAGES: Final = ("viser", "mjviser")

INSTALL: Final = "pip install 'gmijax[view]'"


def missing() -> tuple[str, ...]:
    """The packages of the extra `view` that are not installed."""
    return tuple(name for name in PACKAGES if importlib.util.find_spec(name) is None)
