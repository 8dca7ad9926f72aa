"""How long compiling took here before, for the display while it is awaited again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

from gmijax.errors import ConfigError
from gmijax.runs.cache import cache_folder
from gmijax.runs.folder import read_json, write_json
from gmijax.version import versions_of

_NAME: Final = "compile_times.json"

_MOST: Final = 200
"""Entries that are kept, the newest ones."""


class CompileTime:
    """The seconds of one kind of program, kept in the cache folder.

    Args:
      kind: what the program depends on beside versions: task, sizes, device.
    """

    def __init__(self, kind: Mapping[str, Any]) -> None:
        versions = versions_of(("gmijax", "jax", "jaxlib", "mujoco-mjx"))
        text = json.dumps({**kind, "versions": versions}, sort_keys=True, default=str)
        self._key = hashlib.sha256(text.encode()).hexdigest()[:16]
        seconds = _times().get(self._key)
        self.last_s = seconds if isinstance(seconds, int | float) else None

    def note(self, seconds: float) -> None:
        """Keeps how long it took; of two jobs that do so at once one may be lost."""
        times = _times()
        times.pop(self._key, None)
        kept = dict([*times.items(), (self._key, round(seconds, 1))][-_MOST:])
        with suppress(OSError, ConfigError):
            folder = cache_folder()
            folder.mkdir(parents=True, exist_ok=True)
            write_json(folder / _NAME, kept)


def _times() -> dict[str, Any]:
    with suppress(OSError, ConfigError):
        path = cache_folder() / _NAME
        found = read_json(path) if path.is_file() else {}
        return found
    return {}
