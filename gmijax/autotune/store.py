"""The profile store: what profiles of searches and sweeps found, for the next.

One JSON file for a device, a task with its settings, and the versions of what computes. It is
written after every profile: what was interrupted continues from there, and a second search of the
same job measures nothing.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

from gmijax.autotune.grid import Measured, NotRunnable, Point
from gmijax.config.schema import require_positive
from gmijax.errors import ConfigError, DamagedFile, GmijaxError
from gmijax.runs.cache import cache_folder
from gmijax.runs.folder import make_folder, read_json, write_json
from gmijax.runs.names import nearby

_DIGEST_LENGTH = 10


class ProfileStore:
    """The profiles of one device, task and version.

    Attributes:
      path: the file; it is made with the first profile.
    """

    def __init__(
        self, named: str | None, key: Mapping[str, Any], note: Callable[[str], None]
    ) -> None:
        """Reads what there is; raises ConfigError for a folder that cannot be used.

        `named` is its folder; None: `profiles` in the user's cache. `key` is everything that
        decides what a point does; `device` and `task` name the file. `note` gets a sentence where
        a broken file was moved aside.
        """
        folder = Path(named) if named else cache_folder() / "profiles"
        self._key = dict(key)
        self._note = note
        digest = hashlib.sha256(json.dumps(self._key, sort_keys=True).encode()).hexdigest()
        name = f"{_slug(key['device'])}-{_slug(key['task'])}-{digest[:_DIGEST_LENGTH]}.json"
        self.path = folder / name
        make_folder(folder, f"search.store={folder}")
        self._records = self._load()

    def kept_or(
        self,
        kind: str,
        point: Point,
        measure: Callable[[], Measured | NotRunnable],
        limit_s: float,
    ) -> Measured | NotRunnable:
        """Result of a point: the kept one, else what is measured now, which is kept.

        Args:
          kind: what was profiled; others at the same point are others.
          point: of the grid.
          measure: profiles it; what it raises is not kept.
          limit_s: time that a profile has. What did not end within less is measured again.

        Raises:
          GmijaxError: the file cannot be written, e.g. because the disk is full by now.
        """
        known = self.get(kind, point)
        late_s = known.limit_s if isinstance(known, NotRunnable) else None
        if known is not None and not (late_s and late_s < limit_s):
            return known
        started_s = time.monotonic()
        result = measure()
        self.put(kind, point, result, time.monotonic() - started_s)
        return result

    def get(self, kind: str, point: Point) -> Measured | NotRunnable | None:
        """Result of a point, None where it was not profiled yet."""
        record = self._records.get(_name(kind, point))
        return _result(record) if record else None

    def put(self, kind: str, point: Point, result: Measured | NotRunnable, wall_s: float) -> None:
        """Keeps what a point did, in the file too; raises as `kept_or`."""
        if isinstance(result, NotRunnable):
            fields = {"not_runnable": result.reason, "limit_s": result.limit_s, "wall_s": wall_s}
        else:
            fields = {**result._asdict(), "wall_s": wall_s}
        record = {key: value for key, value in fields.items() if value is not None}
        try:
            with _locked(self.path.with_suffix(".lock")):
                # What another search has found meanwhile stays.
                self._records = {**self._records, **self._load(), _name(kind, point): record}
                write_json(self.path, {"key": self._key, "profiles": self._records})
        except OSError as error:
            raise GmijaxError(
                f"search.store={nearby(self.path.parent)}: cannot be written ({error.strerror})"
            ) from None

    def _load(self) -> dict[str, dict[str, Any]]:
        if not self.path.exists():
            return {}
        try:
            profiles = read_json(self.path)["profiles"]
            for item in profiles.values():
                _result(item)
            return dict(profiles)
        except (ValueError, KeyError, TypeError, AttributeError, ConfigError) as error:
            aside = _moved_aside(self.path)
            why = error.cause if isinstance(error, DamagedFile) else str(error)
            what = " ".join(why.split()) or type(error).__name__
            where = nearby(self.path)
            self._note(f"profile store {where} is broken ({what}): moved to {nearby(aside)}")
            return {}


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Keeps other searches out of a store; file systems that know no locks go without."""
    with path.open("w") as file:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _moved_aside(path: Path) -> Path:
    names = (path.with_name(f"{path.name}.broken{number or ''}") for number in count())
    aside = next(name for name in names if not name.exists())
    try:
        os.replace(path, aside)
    except OSError as error:
        raise ConfigError(
            f"search.store={nearby(path.parent)}: cannot move {path.name} ({error.strerror})"
        ) from None
    return aside


def _name(kind: str, point: Point) -> str:
    return f"{kind} {point.gmis_key}x{point.num_envs} {point.impl}"


def _slug(text: object) -> str:
    return re.sub(r"[^a-z0-9]+", "-", str(text).lower()).strip("-")


def _result(record: Mapping[str, Any]) -> Measured | NotRunnable:
    """Result of a profile in the file; versions without trainers left some figures out."""
    if record.get("not_runnable") is not None:
        return NotRunnable(str(record["not_runnable"]), record.get("limit_s"))
    found = Measured(*(float(record.get(name) or 0.0) for name in Measured._fields))
    for key in ("env_steps_per_s", "memory_mib", "iteration_s"):
        require_positive(key, getattr(found, key))
    return found
