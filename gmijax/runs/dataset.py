"""What serving writes into `output.dir`: names, and what is there already.

`<output.dir>/dataset.json dataset.lock`
`<output.dir>/gmi_000/000000.{npz,json} 000001.{npz,json} ...`

A folder for every GMI that simulates, by its rank among them; a shard is one unroll: arrays
[T, N, ...] and, written after them, a JSON file that describes them. A shard without its JSON
file, or of another size than it has there, is unfinished and is made again.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gmijax.config.schema import flatten
from gmijax.errors import ConfigError, DamagedFile
from gmijax.runs.folder import make_folder, read_json, write_json
from gmijax.runs.names import nearby, shortened

_DIGITS = 6

_MOST_SHOWN: Final = 3
"""Settings that one line names."""


@dataclass(frozen=True)
class ShardPaths:
    """Files of one shard."""

    arrays: Path
    about: Path

    def is_finished(self) -> bool:
        """Whether both files are there, and the arrays are as long as they were written."""
        try:
            return self.arrays.stat().st_size == read_json(self.about)["num_bytes"]
        except (OSError, KeyError, ConfigError):
            return False


@dataclass(frozen=True)
class DataPaths:
    """Files of one folder of experience."""

    root: Path

    @property
    def dataset(self) -> Path:
        """What all shards have in common."""
        return self.root / "dataset.json"

    @property
    def lock(self) -> Path:
        """Empty; a job that writes into the folder holds it."""
        return self.root / "dataset.lock"

    def folder(self, rank: int) -> Path:
        """The shards of the GMI that simulates as number `rank`."""
        return self.root / f"gmi_{rank:03d}"

    def shard(self, rank: int, index: int) -> ShardPaths:
        """Shard number `index` of GMI `rank`."""
        stem = self.folder(rank) / f"{index:0{_DIGITS}d}"
        return ShardPaths(stem.with_suffix(".npz"), stem.with_suffix(".json"))

    def num_finished(self, rank: int) -> int:
        """How many shards of GMI `rank` are finished, from the first on without a gap."""
        count = 0
        while self.shard(rank, count).is_finished():
            count += 1
        return count

    def finished(self) -> Iterator[ShardPaths]:
        """All finished shards, GMI by GMI."""
        # Not a copy that a user made, e.g. gmi_000.bak or gmi_0.
        names = (re.fullmatch("gmi_([0-9]{3,})", path.name) for path in self.root.glob("gmi_*"))
        for rank in sorted({int(name[1]) for name in names if name}):
            for index in range(self.num_finished(rank)):
                yield self.shard(rank, index)


def open_dataset(paths: DataPaths, about: Mapping[str, Any]) -> None:
    """Makes the folder, or checks that what is in it can be continued.

    Raises:
      ConfigError: the folder cannot be written, holds something else, or experience that was
        collected in another way.
    """
    shown = f"output.dir={nearby(paths.root)}"
    try:
        if paths.dataset.exists():
            _check_same(paths, about)
            return
        make_folder(paths.root, shown)
        if any(paths.root.iterdir()):
            raise ConfigError(
                f"{shown}: the folder is not empty and holds no experience "
                f"({paths.dataset.name} is missing)"
            )
        write_json(paths.dataset, about)
    except OSError as error:
        raise ConfigError(f"{shown}: {error.strerror}") from None


def remove_begun(paths: DataPaths, num_simulators: int, *, is_new: bool) -> None:
    """Removes what a job has written before its first shard was finished, and nothing else.

    Args:
      paths: its folder.
      num_simulators: of the job.
      is_new: whether the job has made the folder, which then goes too if it is empty.
    """
    for rank in range(num_simulators):
        shutil.rmtree(paths.folder(rank), ignore_errors=True)
    with suppress(OSError):
        for path in (paths.dataset, paths.lock):
            path.unlink(missing_ok=True)
        if is_new:
            paths.root.rmdir()


def _check_same(paths: DataPaths, about: Mapping[str, Any]) -> None:
    found = read_json(paths.dataset)
    for key, value in about.items():
        if key not in found:
            raise DamagedFile(f"{nearby(paths.dataset)}: broken", f"has no {key}")
        if isinstance(value, Mapping) and not isinstance(found[key], Mapping):
            raise DamagedFile(f"{nearby(paths.dataset)}: broken", f"{key} is no group of keys")
    was, wanted = flatten({key: found[key] for key in about}), flatten(about)
    differing = [
        f"{key}={was.get(key)!r}, this job would add {wanted.get(key)!r}"
        for key in dict.fromkeys((*wanted, *was))
        if was.get(key) != wanted.get(key)
    ]
    if differing:
        raise ConfigError(
            f"output.dir={nearby(paths.root)}: holds experience with "
            f"{shortened(differing, _MOST_SHOWN, '; ')}; use another folder or the same settings"
        )
